"""The task and the frame that every marcher is given."""
