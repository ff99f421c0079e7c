"""The command line: `gsopt VERB ...`, one module per verb. Importing this costs nothing; a verb loads what it needs."""

from __future__ import annotations

import difflib
import importlib
import sys
import warnings
from collections.abc import Callable, Sequence

from gsopt._version import __version__
from gsopt.cli.standard_streams import outlast_readers
from gsopt.errors import GsoptError, InputError, InputWarning, UsageError, refused

VERBS = {
    "sfm": "find the poses of photos or a video",
    "masks": "cut the object out of photos",
    "prompts": "turn an expert's words into the prompts that guide a reconstruction",
    "reconstruct": "go from photos or a video to a report: poses, masks, training",
    "train": "learn Gaussians from posed images",
    "train-many": "learn Gaussians of many scenes, on one machine or many",
    "render": "draw a finished run as images or a video",
    "eval": "judge a finished run by its held-out views",
    "export": "write splats in another format",
    "clean": "leave out splats that no input view needs",
    "merge": "put the splats of two runs of one object together",
    "mesh": "turn the splats of a run into a closed mesh",
    "measure": "measure lengths, and give a run its scale",
    "view": "look at a run or a splat file in the browser",
    "finetune": "train a diffusion prior on scenes of your own",
    "bench": "measure gsopt on this machine",
    "demo": "train on the small scene that ships with gsopt",
    "doctor": "say what is installed, what is missing and how fast this machine is",
}

INTERRUPTED = 130  # 128 + SIGINT, as shells report it
LOGGED = ("train", "demo", "reconstruct")
"""Verbs whose lines stand in log.txt too: no output is lost."""


def main(argv: Sequence[str] | None = None) -> int:
    """Run one verb and return the exit code: 0, a GsoptError's `exit_code`, or 130 when interrupted.

    Output that nobody can read does not stop the verb: it finishes, and the exit code is then 1, or 3 for a full disk.
    """
    beneath = outlast_readers()
    arguments = list(sys.argv[1:] if argv is None else argv)
    try:
        with warnings.catch_warnings():
            warnings.showwarning = _shower(warnings.showwarning)
            warnings.simplefilter("always", InputWarning)
            code = answer(arguments)
        sys.stdout.flush()
        logged = arguments[0] in LOGGED and not {"-h", "--help"} & set(arguments)
        if beneath is None or beneath.failure is None or logged:
            return code
        return code or lost_output(beneath.failure)
    except GsoptError as error:
        print(f"gsopt: {error}", file=sys.stderr)
        return error.exit_code
    except OSError as error:
        print(f"gsopt: {refused(error)}", file=sys.stderr)
        return InputError.exit_code
    except KeyboardInterrupt:
        print("gsopt: interrupted", file=sys.stderr)
        return INTERRUPTED


def _shower(others: Callable[..., None]) -> Callable[..., None]:
    """Shows an InputWarning as one line of gsopt; passes any other warning on."""

    def show(message: Warning | str, category: type[Warning], *where: object) -> None:
        if issubclass(category, InputWarning):
            print(f"gsopt: warning: {message}", file=sys.stderr)
        else:
            others(message, category, *where)

    return show


def lost_output(failure: OSError) -> int:
    """Returns the exit code of a verb whose work is done but whose output was lost; `gsopt ... | head` is no error."""
    if isinstance(failure, BrokenPipeError):
        return 1
    print(f"gsopt: stdout: {refused(failure)}", file=sys.stderr)
    return InputError.exit_code


def answer(arguments: Sequence[str]) -> int:
    """Print help or the version, or run the verb that comes first."""
    first = arguments[0] if arguments else ""
    if first in ("-h", "--help"):
        print(usage())
        return 0
    if first == "--version":
        print(f"gsopt {__version__}")
        return 0
    return run_verb(first, arguments[1:])


def run_verb(verb: str, arguments: Sequence[str]) -> int:
    """Load the verb's module and run its `main`; UsageError for a verb that does not exist."""
    if verb not in VERBS:
        raise UsageError(unknown_verb(verb))
    module = importlib.import_module(f"gsopt.cli.{verb.replace('-', '_')}")
    try:
        code: int = module.main(arguments)
    except SystemExit as stop:  # how argument parsers leave after --help or a wrong flag
        return exit_code(stop)
    return code


def exit_code(stop: SystemExit) -> int:
    """Returns the interpreter's exit code: 0 for None, the number, or 1 after printing a text."""
    if isinstance(stop.code, str):
        print(stop.code, file=sys.stderr)
        return 1
    return stop.code or 0


def unknown_verb(verb: str) -> str:
    """Returns the error for an unknown verb, with the verbs that come closest."""
    if not verb:
        return f"A verb is needed, got none. Give one of {', '.join(VERBS)}; `gsopt --help` explains them."
    close = difflib.get_close_matches(verb, VERBS, n=2, cutoff=0.5)
    advice = f"Did you mean {' or '.join(close)}?" if close else f"Give one of {', '.join(VERBS)}."
    return f"Unknown verb, got {verb!r}. {advice}"


def usage() -> str:
    """The text of `gsopt --help`."""
    width = max(map(len, VERBS))
    verbs = "\n".join(f"  {verb:<{width}}  {purpose}" for verb, purpose in VERBS.items())
    return (
        "usage: gsopt VERB [flags]\n\n"
        "3D Gaussian Splatting from few images.\n\n"
        f"verbs:\n{verbs}\n\n"
        "`gsopt VERB --help` explains a verb's flags; `gsopt --version` prints the version.\n"
        "exit codes: 0 done, 1 done but output lost, 2 wrong flag or missing package, 3 unusable input, "
        "4 numerical failure, 130 interrupted."
    )
