"""The algorithm of the server: clock maps, estimates, plans, solvers and triggers."""
