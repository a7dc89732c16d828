"""Errors that end a command."""


class ConfigError(Exception):
    """A scenario cannot be flown; the message names file, key, given and expected value."""


class NotInstalledError(ConfigError):
    """A scenario or a message needs a package of Skytether that is not installed."""


class FlightError(Exception):
    """A flight could not be completed, or has no results to show."""


class RecordingError(ValueError):
    """A file is not a readable recording; the message is one line with the name of the file."""
