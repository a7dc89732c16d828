"""Triggers, which decide when a horizon is sent.

    trigger   what a policy is, and how policies combine
    policies  policies that our own scenarios use, and `further` the others, in the table TRIGGERS
    guarded   a plug-in's policy with its errors caught

The package imports `shared`, and of the server only `planning`.
"""
