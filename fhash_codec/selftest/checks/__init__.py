"""What must hold for every case of the self-test."""
