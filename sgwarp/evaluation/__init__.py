"""How good and how fast: published protocols on data sets, ablations and rivals, and the report on every knob.

methods.py     what can be compared: lift modes, rivals, the 2D encoder alone
profiles/      one published protocol each
evaluator.py   scenes of a data set, one after the other, resumable
ablation.py    the same with fewer inputs, Gaussians, views, or another method
tables.py      results as Markdown, JSON and LaTeX, beside published numbers (published.json)
report/        error against run time, knob by knob
"""
