"""Triggers, which decide when a horizon is sent.

    trigger   interface of a policy, and combinations of policies
    policies  policies of the built-in scenarios; `further` has others; all in the table TRIGGERS
    guarded   wrapper that catches the errors of a plug-in's policy

The package imports `shared`, and from the server only `planning`.
"""
