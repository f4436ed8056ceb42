"""Pose estimation with the labels: training, prediction, and the score of any method's results.

``score``, ``results``, ``pose_error`` and ``targets`` need no torch; every other module does (extra ``learn``).
"""
