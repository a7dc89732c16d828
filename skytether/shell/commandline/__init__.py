"""What a command line is: options, help, plug-ins, output, and the line that reports an error."""
