"""One file per choice: a sample and settings in, better settings out."""
