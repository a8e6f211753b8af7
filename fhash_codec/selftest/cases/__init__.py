"""The hard cases of the self-test."""
