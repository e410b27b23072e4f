"""The one error that is the user's to mend."""


class InputError(ValueError):  # noqa: N818 - it names the thing at fault, and reads so in `raise`
    """Input that cannot be used; the message says what is, what was expected and what to do."""
