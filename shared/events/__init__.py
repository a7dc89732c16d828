"""Events: what endpoints and processes report, as typed values; a module for each kind."""
