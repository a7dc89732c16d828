"""The same endpoints in virtual time."""
