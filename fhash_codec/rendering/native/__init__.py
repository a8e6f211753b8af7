"""The task as the C++ marcher takes it."""
