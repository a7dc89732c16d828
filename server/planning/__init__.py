"""What every scheme plans with: interface of a scheme, clock of each vehicle, desired states."""
