"""The published network of F-Hash, trained from a random start.

network, storage and model: reading; fit and train: the training; tables and coding: coded
tables; engines: implementations of a training step.
Imports compact for coded tables alone. Reading imports no torch.
"""
