"""Writers of decoded regions, one file a family of formats.

`registry` finds the writer of a path (`save_region`, `save_check`), `common` has the
`Region` that each of them takes. No writer knows a model.
"""
