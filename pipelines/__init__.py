"""The wiring: one module per job a user runs, and the ``brmgeo`` command."""
