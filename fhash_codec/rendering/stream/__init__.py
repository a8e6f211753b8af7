"""The march pass by pass over arrays, in numpy or torch."""
