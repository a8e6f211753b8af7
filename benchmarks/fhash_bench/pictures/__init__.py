"""Pictures: what each effect costs, and VTK and OSPRay beside, in turns.

Commands import `render` and `results`. Each peer has its file; what is measured of fhash alone is
in `render`.
"""
