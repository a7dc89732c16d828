"""Errors that end a command."""


class ConfigError(Exception):
    """A scenario cannot be flown; the message names file, key, given and expected value."""


class NotInstalledError(ConfigError):
    """A scenario, or a message, calls for a room that is not installed."""


class FlightError(Exception):
    """A flight could not be completed, or has nothing to show."""


class RecordingError(ValueError):
    """A file is not a readable recording; the message is one line that names the file."""
