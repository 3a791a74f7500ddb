"""Errors against a reference, baselines, figures and the report. Nothing here is ever aligned before it is scored."""
