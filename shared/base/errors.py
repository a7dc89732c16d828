"""Errors that end a command."""


class ConfigError(Exception):
    """The user's scenario cannot be flown; the message names file, key, given and expected
    value.
    """


class FlightError(Exception):
    """A flight could not be completed, or has nothing to show."""


class RecordingError(ValueError):
    """A file is not a readable recording; the message is one line that names the file."""
