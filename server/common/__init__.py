"""What schemes, MPC and missions share: clock map, interface of schemes, desired window."""
