"""Cost of accuracy on a series: seconds and bytes of encodings, reads and pictures.

Others import `cost` (measure_cost, report_on_encode), `prediction` (time budgets) and `report`
(files); benchmarks take `peers` and `uses`. Nothing that decoding a file needs belongs here.
"""
