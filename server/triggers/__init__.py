"""Triggers, which decide when a horizon is sent.

    trigger   interface of a policy, and combinations of policies
    policies  built-in scenarios' policies; `further` has the others, all in the table TRIGGERS
    guarded   a plug-in's policy with its errors caught

The package imports `shared`, and from the server only `planning`.
"""
