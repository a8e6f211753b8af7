"""The trained head: a small network that corrects each decoded value from its neighbours."""
