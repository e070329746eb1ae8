"""A baseline to compare with: every torque computed by the planner, none by the joint services.

A study object of virtual time. No service imports it and no robot file names it: it can only be
asked for by name, in `xrl sim --control` and `xrl sweep latency --control`.
"""
