"""``dlkf <command> key=value …``, the same as ``python -m dlkf.<command>``; ``dlkf`` alone says what there is.

Completion in bash: ``eval "$(dlkf completion)"`` (commands, keys and presets; zsh reads it after ``bashcompinit``).
"""

from __future__ import annotations

import os
import signal
import sys
from importlib import import_module
from typing import NoReturn

import dlkf

COMMANDS = {
    "simulate": "drives with known truth, as a dataset",
    "ingest": "foreign logs into a dataset",
    "doctor": "what is good and bad about a dataset",
    "navigate": "a filter over whole drives, from IMU and GNSS alone: solution, map, exports",
    "evaluate": "filters against each other on drives with a reference: tables, report",
    "export": "a filter for a vehicle, as C without libraries",
    "train": "train a filter and score it against the classical ones",
    "tune": "fit the noise of a classical filter to drives",
    "allan": "noise of an IMU from a log at rest",
    "consistency": "whether a filter's own 1σ are true",
    "compare": "one page over several evaluations",
    "register": "the model of a run into the registry",
    "ui": "MLflow's pages over the runs of this folder",
}
COMPLETION = r"""_dlkf() {
  local line="${COMP_LINE:0:COMP_POINT}" word="" done="" words
  read -ra words <<< "$line"
  [[ $line == *[[:space:]] ]] || { word="${words[-1]}"; unset 'words[-1]'; }
  [[ $COMP_WORDBREAKS == *=* && $word == *=* ]] && done="${word%=*}="
  COMPREPLY=($(compgen -W "$(dlkf complete "$word" "${words[@]:1}" 2>/dev/null)" -- "$word"))
  COMPREPLY=("${COMPREPLY[@]#"$done"}")
  [[ ${#COMPREPLY[@]} -eq 1 && ${COMPREPLY[0]} == *[.=] ]] && compopt -o nospace
}
complete -o default -F _dlkf dlkf
"""


def main() -> None:
    """Run a command; 2 for an unknown one, 130 after Ctrl-C, even while the libraries load."""
    word, rest = (sys.argv[1] if len(sys.argv) > 1 else "help"), sys.argv[2:]
    signal.signal(signal.SIGTERM, _terminated)
    try:
        if word in ("help", "--help", "-h"):
            print(usage())
        elif word in ("--version", "-V", "version"):
            print(f"dlkf {dlkf.__version__}")
        elif word == "completion":
            print(COMPLETION, end="")
        elif word == "complete":
            print("\n".join(candidates(*(rest or [""]))))
        elif word in COMMANDS:
            sys.argv = [sys.argv[0].replace("__main__.py", "dlkf"), *rest]
            os.environ["DLKF_COMMAND"] = f"dlkf {word}"
            import_module(f"dlkf.{word}").main()
        else:
            print(f"dlkf: error: unknown command {word!r}; known: {', '.join(COMMANDS)}", file=sys.stderr)
            sys.exit(2)
    except KeyboardInterrupt:
        print("dlkf: interrupted", file=sys.stderr)
        sys.exit(130)


def _terminated(*_: object) -> NoReturn:
    print("dlkf: terminated", file=sys.stderr)
    sys.exit(143)


def usage() -> str:
    """What there is."""
    width = max(map(len, COMMANDS))
    lines = "\n".join(f"  {name.ljust(width)}  {what}" for name, what in COMMANDS.items())
    return (
        f"dlkf {dlkf.__version__}: Kalman filters for GNSS and IMU, and a learned one\n\n"
        f"usage: dlkf <command> key=value …\n\n{lines}\n\n"
        "dlkf <command> --help shows its settings, --cfg job prints them all with their values.\n"
        'Completion: eval "$(dlkf completion)"'
    )


def candidates(word: str, *before: str) -> list[str]:
    """Words that may stand for this one: commands, keys of the command before it, nested ones, presets, values."""
    if not before or before[0] not in COMMANDS:
        return [c for c in COMMANDS if c.startswith(word)]
    from dlkf.config import config_dir

    if not (config_dir() / f"{before[0]}.yaml").is_file():
        return []
    from dlkf.command.completion import completed

    return completed(before[0], word, before[1:])


if __name__ == "__main__":
    main()
