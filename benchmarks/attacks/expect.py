"""What a command should have done."""

from benchmarks.attacks.commands import TIMEOUT, Done

_MOST_LINES = 60  # a longer message is not read
_MOST_GB = 3.0  # small input must not fill the memory


def refused(done: Done, *words: str) -> str:
    """The fault, or "" if the command ended with status 1 and a message, not too long, that holds all words."""
    fault = _crashed(done)
    if fault:
        return fault
    if done.status == 0:
        return "accepted, exit status 0"
    if done.status != 1:
        return f"exit status {done.status}"
    if not done.stderr.strip() and not done.stdout.strip():
        return "no message"
    if len(done.text.splitlines()) > _MOST_LINES:
        return f"a message of {len(done.text.splitlines())} lines"
    missing = [word for word in words if word.lower() not in done.text.lower()]
    return f"the message does not say {missing[0]!r}: {_first_line(done)}" if missing else ""


def accepted(done: Done, *words: str) -> str:
    """The fault, or "" if the command ended with status 0 and printed all words."""
    fault = _crashed(done)
    if fault:
        return fault
    if done.status != 0:
        return f"exit status {done.status}: {_first_line(done)}"
    missing = [word for word in words if word.lower() not in done.text.lower()]
    return f"does not say {missing[0]!r}" if missing else ""


def _crashed(done: Done) -> str:
    """What no input may cause."""
    if done.status == TIMEOUT:
        return f"did not end within {done.seconds:.0f} s"
    if done.status < 0:
        return f"killed by signal {-done.status}"
    if "Traceback (most recent call last)" in done.text:
        return f"traceback: {done.text.strip().splitlines()[-1][:150]}"
    if done.peak_gb > _MOST_GB:
        return f"took {done.peak_gb:.1f} GB of memory"
    return ""


def _first_line(done: Done) -> str:
    return (done.stderr.strip() or done.stdout.strip() or "(nothing)").splitlines()[0][:150]
