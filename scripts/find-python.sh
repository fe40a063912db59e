#!/bin/sh
# Prints the first Python that is new enough, or says what is missing.
for candidate in "${PYTHON:-}" python3 python3.13 python3.12 python3.11; do
    [ -n "$candidate" ] && command -v "$candidate" >/dev/null || continue
    if "$candidate" -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null; then
        command -v "$candidate"
        exit 0
    fi
done
echo "no python 3.11 or newer found; on Debian 12 or Ubuntu 24.04: apt-get install python3 python3-venv" >&2
exit 1
