"""Pictures: what each effect costs, and VTK beside."""
