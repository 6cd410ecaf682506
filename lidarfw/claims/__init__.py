"""Claims: what a method is said to gain, stated in a file, tested with runs, judged with intervals.

`reading` has the file, `running` makes the runs that are missing, `judging` compares, `reporting` writes the table.
"""
