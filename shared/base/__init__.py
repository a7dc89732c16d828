"""What everything else stands on: units of time, named chance, files, hints, errors for users."""
