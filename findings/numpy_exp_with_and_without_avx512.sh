#!/usr/bin/env bash
# One NumPy wheel computes exp, log, tan and arctan2 to other last bits on processors with AVX-512 than without.
#
# Guess: on x86-64, one wheel gives one result for one number; only another architecture or release could differ.
# Result, with numpy 2.4.6, for 100 000 float64 numbers: exp, log, tan, arctan2 and power differ in the last bits if
# the loops for AVX-512 are disabled, as on a processor without it. sin, cos, tanh and sqrt are equal.
# So a record can be bit-equal on one computer and not on another, although all versions agree.
#
# Needs python3 (3.11 or later) with venv, and a processor with AVX-512.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cd "$folder"
grep -q avx512_skx /proc/cpuinfo || grep -q avx512f /proc/cpuinfo || { echo "no AVX-512 here: nothing to compare"; exit 0; }
python3 -m venv env
env/bin/python -m pip install -q "numpy==2.4.6"
cat > compute.py <<'EOF'
import sys

import numpy as np

x = np.random.default_rng(1).uniform(0.1, 5.0, 100_000)
y = x[::-1].copy()
names = ("exp", "log", "tan", "sin", "cos", "tanh", "sqrt")
results = {name: getattr(np, name)(x) for name in names}
np.savez(sys.argv[1], arctan2=np.arctan2(x, y), power=np.power(x, y), **results)
EOF
env/bin/python compute.py with.npz
off=$(env/bin/python -c '
from numpy._core._multiarray_umath import __cpu_dispatch__ as names
print(" ".join(name for name in names if "512" in name or name in ("X86_V4",)))')
NPY_DISABLE_CPU_FEATURES="$off" env/bin/python compute.py without.npz
env/bin/python - <<'EOF'
import numpy as np

one, other = np.load("with.npz"), np.load("without.npz")
differing = {name: int(np.count_nonzero(one[name] != other[name])) for name in one.files}
print("numpy", np.__version__)
for name, count in differing.items():
    print(f"{name:8} {count:6} of 100000 differ")
assert all(differing[name] for name in ("exp", "log", "tan", "arctan2", "power")), "they are equal now"
assert not any(differing[name] for name in ("sin", "cos", "tanh", "sqrt"))
print("as found")
EOF
