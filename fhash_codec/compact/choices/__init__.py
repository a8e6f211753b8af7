"""One file per choice of the compact profile: sample and settings in, better settings out."""
