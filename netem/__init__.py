"""Network emulator: the bad network between the two, a UDP proxy that never reads its packets."""
