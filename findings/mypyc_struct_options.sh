#!/usr/bin/env bash
# mypyc 2.4.1 drops the options of a msgspec 0.22.0 Struct without a warning.
#
# Guess: a compiled module behaves like its source, or mypyc refuses to compile it. So a compiled class
# has the options of its class statement, such as `frozen=True`.
# Result: compilation succeeds, but the compiled class is neither frozen nor hashable nor tagged. An
# attribute can be set, hash() raises TypeError, and the JSON lacks the tag. mypyc also drops
# `kw_only=True`; the import then fails if a required field follows an optional field.
# Therefore mypyc cannot make the joint service's control cycle faster, because its laws keep their state
# in structs.
#
# Needs python3 with venv and headers, and a C compiler.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cd "$folder"
python3 -m venv env
env/bin/python -m pip install -q "mypy==2.4.1" "msgspec==0.22.0" "setuptools==84.2.1"
cat > fixed.py <<'EOF'
import msgspec


class Fixed(msgspec.Struct, frozen=True, tag="fixed"):
    x: int
EOF
cat > look.py <<'EOF'
import msgspec

import fixed

kind = "source" if fixed.__file__.endswith(".py") else "compiled"
one = fixed.Fixed(1)
try:
    one.x = 2
    frozen = "mutable"
except AttributeError:
    frozen = "frozen"
try:
    hash(one)
    hashed = "hashable"
except TypeError:
    hashed = "not hashable"
print(kind, frozen, hashed, msgspec.json.encode(fixed.Fixed(1)).decode(), sep=", ")
EOF
as_source=$(env/bin/python look.py)
env/bin/mypyc fixed.py > build.log 2>&1 || { cat build.log; exit 3; }
compiled=$(env/bin/python look.py)
printf '%s\n' "$as_source" "$compiled"
[[ "$as_source" == 'source, frozen, hashable, {"type":"fixed","x":1}' ]]
[[ "$compiled" == 'compiled, mutable, not hashable, {"x":1}' ]]
echo "as found"
