#!/usr/bin/env bash
# In CasADi a NaN equals itself: the test for NaN that works everywhere else is simplified away.
#
# Guess: `x == x` in a symbolic graph is evaluated with the numbers, as in C, NumPy and Python, so its negation
# finds a NaN.
# Result, with casadi 3.8.2: with SX and MX, `x == x` is the constant 1 and `x != x` the constant 0 as soon as they
# are written, whatever x will be. A check built on it never fires, and no warning is given.
# `ca.logic_not(ca.logic_or(x <= 0, x > 0))` finds a NaN.
#
# Needs python3 with venv.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cd "$folder"
python3 -m venv env
env/bin/python -m pip install -q "casadi==3.8.2"
env/bin/python - <<'EOF'
import math

import casadi as ca

print("casadi", ca.__version__)
for kind in (ca.SX, ca.MX):
    x = kind.sym("x")
    of = ca.Function("f", [x], [x == x, x != x, ca.logic_not(ca.logic_or(x <= 0, x > 0))])
    equal, differs, is_nan = (float(value) for value in of(math.nan))
    print(f"{kind.__name__}: NaN == NaN is {equal:g}, NaN != NaN is {differs:g}, neither <= 0 nor > 0: {is_nan:g}")
    assert (equal, differs, is_nan) == (1.0, 0.0, 1.0), "it has changed"
    assert [float(value) for value in of(2.0)] == [1.0, 0.0, 0.0]
print("as found")
EOF
