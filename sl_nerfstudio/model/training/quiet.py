"""What nerfstudio prints by itself, left out: settings are in config.yml, and phases say what happens."""

from nerfstudio.utils.rich_utils import CONSOLE


def quiet_nerfstudio(quiet: bool) -> None:
    """Whether this process prints nothing through nerfstudio's console from now on; errors do not go through it."""
    CONSOLE.quiet = quiet
