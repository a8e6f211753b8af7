"""The cost of an encoding: predicted before, measured after."""
