"""Functions of the operating system: sockets, timers, files, features that may be missing."""
