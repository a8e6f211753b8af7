"""The properties that must hold for the cases of the self-test."""
