"""Flags whose value may be left out: --view, --web and their ports, --turntable and its seconds."""

from collections.abc import Callable, Sequence


def with_port(words: Sequence[str], flag: str, port: int) -> list[str]:
    """The command line with the port that may be left out after a flag."""
    return _filled(words, flag, str(port), lambda word: word.isdecimal())


def with_value(words: Sequence[str], flag: str, value: float) -> list[str]:
    """The command line with the number that may be left out after a flag."""
    return _filled(words, flag, f"{value:g}", _is_number)


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True


def _filled(words: Sequence[str], flag: str, value: str, fits: Callable[[str], bool]) -> list[str]:
    """argparse would take the next word for the value, whatever that is."""
    filled: list[str] = []
    for place, word in enumerate(words):
        filled.append(word)
        after = words[place + 1] if place + 1 < len(words) else ""
        if word == flag and not fits(after):
            filled.append(value)
    return filled
