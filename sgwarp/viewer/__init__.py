"""Looking at a scene in the browser: ask it, click at it, take what was found.

The state of a tab (`tab`, `workbench`, `questions`, `modes`, `clicks`) knows nothing of the browser; `server`, `panel`
and `guard` are the layer on viser.
"""
