"""Why an avatar is not written."""


class ExportRefused(RuntimeError):  # noqa: N818 - it names what happened, and reads so in `raise`
    """The package would not draw what the avatar looks like; nothing was written."""
