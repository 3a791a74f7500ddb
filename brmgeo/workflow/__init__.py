"""Stages, their keys and records, the store that keeps their outputs, and where they run.

This room knows keys, files and processes, never what a stage computes. Dask is imported here only, and only
when there is work for it.
"""
