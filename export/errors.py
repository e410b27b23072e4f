"""Why an avatar is not written."""


class ExportRefused(RuntimeError):  # noqa: N818 - it names what happened, and reads so in `raise`
    """Nothing to draw, or a graph that does not compute what it should; nothing is written."""
