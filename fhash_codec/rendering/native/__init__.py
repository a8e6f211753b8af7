"""The native marcher: a task in its units, its structure, and marching by it."""
