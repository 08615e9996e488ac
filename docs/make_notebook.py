"""An example as a notebook to click through, run once so that it has its output: build/notebook.ipynb.

Its cells are the steps of the function `main` of the example, on captures that the first cell makes.
"""

import ast
import json
import textwrap
from pathlib import Path

import nbclient
import nbformat

ROOT = Path(__file__).parents[1]
EXAMPLE = ROOT / "examples" / "02_two_frames_to_a_cloud.py"
FOLDER = ROOT / "build"
CAPTURES = {"captures": "captures", "output": "cloud.npy"}
MAKE = (
    "from sl_nerfstudio.synthesis.config import SynthConfig\n"
    "from sl_nerfstudio.synthesis.synthesise import synthesise\n\n"
    'if not Path("captures").exists():\n'
    '    synthesise(SynthConfig(frames=2, resolution=300, images_only=True), Path("captures"))'
)


def notebook(example: Path) -> nbformat.NotebookNode:
    """The example's docstring, its imports, its captures, and a cell for every statement of `main`."""
    text = example.read_text()
    tree = ast.parse(text)
    lines = text.splitlines()
    imports = [ast.unparse(node) for node in tree.body if isinstance(node, ast.Import | ast.ImportFrom)]
    main = next(node for node in tree.body if isinstance(node, ast.FunctionDef) and node.name == "main")
    title = (ast.get_docstring(tree) or "").splitlines()[0]
    new = nbformat.v4
    cells = [new.new_markdown_cell(f"# {title}"), new.new_code_cell("\n".join(imports)), new.new_code_cell(MAKE)]
    cells.append(new.new_code_cell("\n".join(f"{name} = {json.dumps(value)}" for name, value in CAPTURES.items())))
    for node in main.body[1:]:
        cells.append(new.new_code_cell(textwrap.dedent("\n".join(lines[node.lineno - 1 : node.end_lineno]))))
    return new.new_notebook(cells=cells)


def main() -> None:
    """Build it, run it, write it. Raises nbclient's CellExecutionError for a cell that fails."""
    FOLDER.mkdir(exist_ok=True)
    made = notebook(EXAMPLE)
    nbclient.NotebookClient(made, timeout=None, resources={"metadata": {"path": str(FOLDER)}}).execute()
    nbformat.write(made, FOLDER / "notebook.ipynb")
    print(f"notebook: {FOLDER / 'notebook.ipynb'}")


if __name__ == "__main__":
    main()
