"""Errors that end what a user has asked for."""


class ConfigError(Exception):
    """The user's scenario cannot be flown; the message names file, key, given and expected."""


class FlightError(Exception):
    """A flight could not be flown to its end, or has nothing to show."""


class RecordingError(ValueError):
    """A file is no recording, or none that can be read; one line that names the file."""
