"""Events: reports of endpoints and processes, as typed values; there is a module for each kind."""
