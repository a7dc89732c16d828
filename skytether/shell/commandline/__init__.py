"""Command line: options, help, plug-ins, output, and the one-line report of an error."""
