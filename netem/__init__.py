"""Network emulator: a UDP proxy that delays, loses and reorders packets without reading them."""
