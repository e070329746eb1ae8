"""A baseline to compare with: the planner computes every torque, the joint services none.

It runs in virtual time only. No service imports it and no robot file names it: `xrl sim --control`
and `xrl study latency --control` select it by name.
"""
