# Sourced by each finding: `fresh PACKAGE==VERSION ...` makes a temporary folder with an environment of its own, and removes it at the end.
# `see NAME`, with a program on standard input, runs it there. The program prints what it saw, and exits with 1 if that changed.
# It may import `onnx_model` and `open_drive`.
set -euo pipefail

fresh() {
    folder=$(mktemp -d)
    trap 'rm -rf "$folder"' EXIT
    "${PYTHON:-python3}" -m venv "$folder/venv"
    "$folder/venv/bin/python" -m pip install --quiet --disable-pip-version-check "$@" 2>"$folder/pip.log" ||
        { cat "$folder/pip.log" >&2; exit 2; }
}

see() {
    cat >"$folder/seen.py"
    cp "$(dirname "${BASH_SOURCE[0]}")"/*.py "$folder"
    (cd "$folder" && OMP_NUM_THREADS=1 venv/bin/python -W ignore seen.py 2>"$folder/errors.log") ||
        { status=$?; tail -5 "$folder/errors.log" >&2; exit "$status"; }
}

# `fresh_node PACKAGE@VERSION ...` and `see_node` are the same for JavaScript; they need node and npm.
fresh_node() {
    folder=$(mktemp -d)
    trap 'rm -rf "$folder"' EXIT
    (cd "$folder" && npm install --silent --no-audit --no-fund "$@" >npm.log 2>&1) || { cat "$folder/npm.log" >&2; exit 2; }
}

see_node() {
    cat >"$folder/seen.js"
    (cd "$folder" && node seen.js 2>errors.log) || { tail -5 "$folder/errors.log" >&2; exit 1; }
}
