"""How every command of the package ends: faults that a user can correct are shown without a traceback."""

import os
import sys
from collections.abc import Callable

from sl_nerfstudio.errors import UserError

EXIT_FAULT = 1
EXIT_INTERRUPTED = 130  # 128 + SIGINT, as shells expect


def run(main: Callable[[], None]) -> None:
    """Call `main`; a `UserError` becomes `error: ...` on stderr and exit status 1, control-C status 130.

    Anything else is a bug in this package and keeps its traceback.
    """
    try:
        main()
        sys.stdout.flush()
    except UserError as error:
        print(f"error: {error}", file=sys.stderr)
        sys.exit(EXIT_FAULT)
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        sys.exit(EXIT_INTERRUPTED)
    except BrokenPipeError:
        # The reader (`head`, a pager) has gone; what is still buffered must not raise again at exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(EXIT_FAULT)
