"""What is made of flights: figures and comparisons."""
