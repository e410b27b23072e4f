"""Flags of the commands that open a page: --view, --web, each with a port that may be left out."""

from collections.abc import Sequence


def with_port(words: Sequence[str], flag: str, port: int) -> list[str]:
    """The command line with the port that may be left out after a flag.

    argparse would take the next word for it, whatever that is.
    """
    filled: list[str] = []
    for word, after in zip(words, [*words[1:], ""], strict=True):
        filled.append(word)
        if word == flag and not after.isdecimal():
            filled.append(str(port))
    return filled
