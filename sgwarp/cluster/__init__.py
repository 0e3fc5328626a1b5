"""Many scenes: a list of them, what is done with each, and who does it: processes of this machine, or a Ray cluster.

A scene is a task. Only paths travel; what is done is read from the folders of the scenes, so nothing is lost with a
process, and a run that starts again skips what is there.
"""
