"""Parts that several writers share."""
