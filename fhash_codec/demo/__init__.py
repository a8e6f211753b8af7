"""The series and the picture of `fhash demo`."""
