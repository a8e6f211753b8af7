"""The command line: `main`, and the options, the output and the selections that commands share.

From outside: `main.program` and `main.main`; `options` and `output` for commands of other packages.
No algorithm; no heavy import at the top of a module, so that `fhash` starts at once.
"""
