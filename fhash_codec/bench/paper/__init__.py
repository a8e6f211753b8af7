"""The input encodings of the F-Hash paper's evaluation, trained side by side."""
