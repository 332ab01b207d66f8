"""Runtime adaptation: the paper's multi-metric cost function (section "Multi-Metric Cost Function", eq. (mmcf)).

`model` what is measured, chosen and reported; `cost` weights, ranges and the four terms; `predict` what a configuration
would do; `residuals` what experience says about the predictions; `policy` the choice, and the paper's baselines.
"""
