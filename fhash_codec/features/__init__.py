"""Features of a series: what is encoded of it, key frames, occupancy, and the coreset.

selection: sources as series, and all that is selected; scan: range and missing values of all steps.
Imports boxes, config, measure and progress. Nothing here knows a profile or a file.
"""
