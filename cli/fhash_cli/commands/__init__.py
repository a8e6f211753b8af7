"""The commands of `fhash`, one file each."""
