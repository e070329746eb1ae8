#!/usr/bin/env bash
# zstd compresses JSON rows of measured doubles less at its default level than at level 1.
#
# Guess: a higher level compresses more and takes more time, so the default, level 3, suits a log of JSON
# messages.
# Result, with zstandard 0.25.0 (libzstd 1.5.7) on 2 MB of rows with 24 noisy doubles each, in blocks of
# 1 MiB: level 1 compresses to 39 %, level 3 to 43 %, and no level from 2 to 12 to less than 41 %. Level 19
# compresses to 33 %, in a hundred times the time. Level 1 keeps literals together, and Huffman coding
# shortens their digits. Higher levels find short matches, which cost more than they save.
# The mcap package compresses chunks at level 3 and has no option for another level.
#
# Needs python3 with venv.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cd "$folder"
python3 -m venv env
env/bin/python -m pip install -q "zstandard==0.25.0"
env/bin/python - <<'EOF'
import json
import math
import random

import zstandard

random.seed(1)
rows = []
for i in range(4000):
    q = [math.sin(0.003 * i + k) + 1e-4 * random.gauss(0.0, 1.0) for k in range(12)]
    v = [0.75 * math.cos(0.003 * i + k) + 1e-3 * random.gauss(0.0, 1.0) for k in range(12)]
    row = {"t_ns": 4_000_000 * i, "seq": i, "q": q, "v": v, "mode": 2, "ready": True}
    rows.append(json.dumps(row, separators=(",", ":")))
data = "\n".join(rows).encode()
blocks = [data[at : at + (1 << 20)] for at in range(0, len(data), 1 << 20)]
left = {
    level: sum(len(zstandard.compress(block, level)) for block in blocks) / len(data)
    for level in (1, 2, 3, 5, 9, 12, 19)
}
print(zstandard.__version__, zstandard.ZSTD_VERSION)
for level, part in left.items():
    print(f"level {level:2}: {100 * part:.1f} %")
assert left[1] < 0.92 * left[3], "level 3 is no longer 8 % larger"
assert left[1] < min(left[level] for level in (2, 5, 9, 12))
print("as found")
EOF
