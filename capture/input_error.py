"""The one error that is the user's to mend."""


class InputError(ValueError):
    """Input that cannot be used; the message says what is, what was expected and what to do."""
