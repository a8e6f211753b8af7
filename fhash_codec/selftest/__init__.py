"""Hard cases: data, settings and scenes on which codecs and renderers break, and what must hold.

Others import `run` (choose_cases, run_cases, markdown). A case is data and settings; a check reads
a run through public functions, or compares it with an oracle in float64 beside it.
"""
