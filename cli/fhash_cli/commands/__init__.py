"""The commands of `fhash`: a file each, or one of those that are read together.

Only `main` imports them, when they are run; `main.FILES` names the files of several commands.
What two commands share lies in the modules above.
"""
