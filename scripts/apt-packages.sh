#!/bin/sh
# Installs the Debian or Ubuntu packages that are missing, and says so. Usage: apt-packages.sh run|test|truth
set -eu
packages="python3-venv gcc libc6-dev libgl1 libegl1 libegl-mesa0 libgl1-mesa-dri"
if [ "${1:-run}" = test ]; then
    packages="$packages chromium coturn iproute2 nginx libnginx-mod-rtmp python3-gi gir1.2-gst-rtsp-server-1.0 gstreamer1.0-tools
        gstreamer1.0-plugins-base gstreamer1.0-plugins-good gstreamer1.0-plugins-bad gstreamer1.0-plugins-ugly"
    command -v node >/dev/null && command -v npm >/dev/null || packages="$packages nodejs npm"
fi
[ "${1:-run}" != truth ] || packages="$packages libllvm19"
missing=""
for package in $packages; do
    dpkg-query -W -f '${Status}' "$package" 2>/dev/null | grep -q "ok installed" || missing="$missing $package"
done
[ -n "$missing" ] || exit 0
if ! command -v apt-get >/dev/null; then
    echo "missing packages:$missing; expected Debian or Ubuntu, install them by hand" >&2
    exit 1
fi
echo "installing with apt-get:$missing"
as_root=""
[ "$(id -u)" = 0 ] || as_root="sudo"
$as_root apt-get update -qq
# shellcheck disable=SC2086  # a list of words
DEBIAN_FRONTEND=noninteractive $as_root apt-get install -y -qq --no-install-recommends $missing >/dev/null
