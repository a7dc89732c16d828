"""Virtual time: the same endpoints as over UDP, on a clock that jumps from event to event."""
