#!/bin/sh
# Builds the image where no container engine runs and no registry of images can be reached: buildah with chroot isolation
# on a base made by debootstrap. Needs root and `apt-get install buildah debootstrap`.
#   docker/build-without-engine.sh         builds mr360 and starts it once, until /readyz answers
set -eu
cd "$(dirname "$0")/.."
work=${MR360_BUILD_DIR:-/tmp/mr360-image}
port=$(python3 -c 'import socket; s = socket.socket(); s.bind(("127.0.0.1", 0)); print(s.getsockname()[1])')
export STORAGE_DRIVER=vfs BUILDAH_ISOLATION=chroot
buildah() { command buildah --root "$work/storage" --runroot "$work/run" "$@"; }
mkdir -p "$work"

if ! buildah inspect --type image localhost/mr360-base >/dev/null 2>&1; then
  if [ ! -d "$work/base" ]; then
    rm -rf "$work/base.partial"
    debootstrap --variant=minbase bookworm "$work/base.partial" ${DEBIAN_MIRROR:+"$DEBIAN_MIRROR"}
    mv "$work/base.partial" "$work/base"
  fi
  printf 'FROM scratch\nCOPY . /\nCMD ["/bin/sh"]\n' > "$work/base.Dockerfile"
  buildah bud -f "$work/base.Dockerfile" -t mr360-base "$work/base"
fi

# A package index behind a proxy may want this machine's certificates.
certificates=${PIP_CERT:-/etc/ssl/certs/ca-certificates.crt}
printf '[global]\ncert = /run/certificates.crt\n' > "$work/pip.conf"
buildah bud --format docker -f docker/Dockerfile --ignorefile docker/Dockerfile.dockerignore \
  --build-arg BASE=localhost/mr360-base --volume "$work/pip.conf:/etc/pip.conf:ro" \
  --volume "$certificates:/run/certificates.crt:ro" -t mr360 .

container=$(buildah from mr360)
server=
trap '[ -z "$server" ] || kill -- "-$server" 2>/dev/null; wait; buildah rm "$container" >/dev/null' EXIT
# A session of its own, so that one signal reaches buildah, its chroot child and the service.
setsid buildah --root "$work/storage" --runroot "$work/run" run "$container" -- \
  mr360 serve --host 127.0.0.1 --port "$port" &
server=$!
for _ in $(seq 90); do
  kill -0 "$server" || exit 1
  if curl --silent --fail "http://127.0.0.1:$port/readyz"; then
    echo
    curl --silent "http://127.0.0.1:$port/api/streams/live"
    echo
    exit 0
  fi
  sleep 1
done
echo "the service did not become ready" >&2
exit 1
