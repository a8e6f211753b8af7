"""One picture: planned, explained and finished."""
