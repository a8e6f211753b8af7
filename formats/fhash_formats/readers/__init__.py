"""Readers of time-varying volumes: one file a format or a family of formats.

`registry` finds the reader of a path (`open_series`, `list_variables`, `open_mask`); `joined` makes
one series of many files. `common/` holds what several formats share: the user's request, variables
and axes, coordinates, packed values, stored bytes. Nothing is imported here, so that a command
loads the readers alone that it uses; no reader of a format imports a writer or the container.
"""
