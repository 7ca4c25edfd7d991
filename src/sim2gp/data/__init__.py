"""Data to learn from. Importing it loads no simulator: a log is read without one.

`transitions` and `windows` are what is learned from; `one_step` and
`windows_likelihood` say how well a machine explains them; `split_log`, `grid` and
`one_step_log` make them of logs, which `logs` reads.
"""
