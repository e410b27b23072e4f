"""Flags whose value may be left out: --view, --web and their ports, --turntable and its seconds."""

from collections.abc import Callable, Sequence


def fill_optional_port(argv: Sequence[str], flag: str, port: int) -> list[str]:
    """The command line with the port that may be left out after a flag."""
    return _fill_optional(argv, flag, str(port), lambda word: word.isdecimal())


def fill_optional_number(argv: Sequence[str], flag: str, value: float) -> list[str]:
    """The command line with the number that may be left out after a flag."""
    return _fill_optional(argv, flag, f"{value:g}", _is_number)


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True


def _fill_optional(argv: Sequence[str], flag: str, value: str, is_value: Callable[[str], bool]) -> list[str]:
    """argparse would take the next word for the value, whatever that is."""
    filled: list[str] = []
    for place, word in enumerate(argv):
        filled.append(word)
        after = argv[place + 1] if place + 1 < len(argv) else ""
        if word == flag and not is_value(after):
            filled.append(value)
    return filled
