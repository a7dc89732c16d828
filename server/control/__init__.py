"""The schemes of the server: clock maps, estimates, plans and solvers."""
