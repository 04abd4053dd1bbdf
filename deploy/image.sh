#!/bin/sh
# Build the container image with buildah: deploy/image.sh [TAG] [argument of buildah build]... TAG is neurove by default.
# The base image is python:3.11-slim. Where no registry is reached, or with BASE=debian, mmdebstrap makes one from the
# packages of Debian 12; BASE=IMAGE takes another one. See README.md, Container.
set -eu
cd "$(dirname "$0")/.."
tag=${1:-neurove}
[ $# = 0 ] || shift
export BUILDAH_ISOLATION="${BUILDAH_ISOLATION:-chroot}" # needs no runtime for containers and no privileges of its own
registry=docker.io/library/python:3.11-slim
local=localhost/neurove-base

need() {
    command -v "$1" > /dev/null || { echo "image.sh: $1 is missing: apt-get install $1" >&2; exit 1; }
}

# Only what Python needs: no manuals, no translations.
from_debian() {
    need mmdebstrap
    archive=$(mktemp --suffix=.tar)
    trap 'rm -f "$archive"' EXIT
    mmdebstrap --quiet --variant=minbase --include=python3,python3-venv,python-is-python3,ca-certificates \
        --dpkgopt='path-exclude=/usr/share/man/*' --dpkgopt='path-exclude=/usr/share/locale/*' \
        --dpkgopt='path-exclude=/usr/share/doc/*' --dpkgopt='path-include=/usr/share/doc/*/copyright' \
        bookworm "$archive"
    container=$(buildah from scratch)
    buildah add --quiet "$container" "$archive" / > /dev/null
    buildah commit --quiet --rm "$container" "$local" > /dev/null
}

need buildah
base=${BASE:-$registry}
if [ "$base" = debian ] || { [ "$base" = "$registry" ] && ! buildah pull --quiet "$registry" > /dev/null 2>&1; }; then
    echo "image.sh: base image from packages of Debian 12"
    buildah inspect --type image "$local" > /dev/null 2>&1 || from_debian
    base=$local
fi
buildah build --format docker --layers --build-arg PYTHON_IMAGE="$base" --file deploy/Containerfile \
    --ignorefile deploy/Containerfile.dockerignore --tag "$tag" "$@" .
size=$(buildah inspect --type image --format '{{.FromImageID}}' "$tag")
echo "$tag: $(buildah images --format '{{.Size}}' "$size"), uncompressed"
