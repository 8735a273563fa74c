#!/bin/sh
# Build dist/tactomo_VERSION_ARCH.deb (`make deb`): the daemon with everything it needs in an
# environment of its own under /usr/lib/tactomo, and the units, rules and users of the service.
#
#     deploy/debian/build.sh [PYTHON OF THE DEVELOPERS' ENVIRONMENT]
#
# The package runs on the Python that the target's distribution has, so build on that distribution;
# $PYTHON names another one than /usr/bin/python3. What is installed is what requirements.lock pins.
set -eu
cd "$(dirname "$0")/../.."

PYTHON=${PYTHON:-/usr/bin/python3}
HOME_DIR=/usr/lib/tactomo
BUILDER=${1:-.venv/bin/python}
PIP="$BUILDER -m pip --disable-pip-version-check --quiet"
VERSION=$(sed -n 's/^version = "\(.*\)"/\1/p' pyproject.toml)
ARCH=$(dpkg --print-architecture)
PYTHON_PACKAGE=$("$PYTHON" -c 'import sys; print("python%d.%d" % sys.version_info[:2])')

work=$(mktemp -d)
commit=daemon/tactomo/commit.txt  # of which `tactomo --version` tells
trap 'rm -rf "$work" "$commit"' EXIT
git describe --always --dirty --abbrev=12 > "$commit" || rm -f "$commit"
root=$work/root
venv=$root$HOME_DIR
mkdir -p "$venv" dist

echo "wheels"
$PIP wheel --no-build-isolation --no-deps --wheel-dir "$work" clients/python .

echo "environment"
"$PYTHON" -m venv --without-pip --symlinks "$venv"
"$BUILDER" deploy/debian/runtime_requirements.py > "$work/requirements.txt"
# --no-deps, twice: nothing comes that is not pinned, and `pip check` says if anything is missing.
$PIP --python "$venv/bin/python" install --no-compile --no-deps --require-hashes -r "$work/requirements.txt"
$PIP --python "$venv/bin/python" install --no-compile --no-deps "$work"/*.whl
$PIP --python "$venv/bin/python" check
# It moves to another place: nothing in it may name this one.
find "$venv/bin" -type f ! -name tactomo -delete
sed -i "1s|.*|#!$HOME_DIR/bin/python|" "$venv/bin/tactomo"
sed -i '/^command/d' "$venv/pyvenv.cfg"
find "$venv" -name direct_url.json -delete
"$venv/bin/python" -m compileall -q --invalidation-mode unchecked-hash -s "$root" "$venv/lib"

echo "files of the service"
install -d "$root/usr/bin" "$root/usr/share/doc/tactomo/examples"
ln -s "$HOME_DIR/bin/tactomo" "$root/usr/bin/tactomo"
install -D -m 644 -t "$root/usr/lib/systemd/system" deploy/systemd/*.service
install -D -m 644 -t "$root/usr/lib/udev/rules.d" deploy/udev/*.rules
install -D -m 644 deploy/sysusers.conf "$root/usr/lib/sysusers.d/tactomo.conf"
install -D -m 644 deploy/tmpfiles.conf "$root/usr/lib/tmpfiles.d/tactomo.conf"
install -m 644 deploy/README.md clients/STREAM.md CHANGELOG.md "$root/usr/share/doc/tactomo"
install -m 644 LICENSE "$root/usr/share/doc/tactomo/copyright"
install -m 644 deploy/daemon.example.toml deploy/examples/* deploy/systemd/network.conf \
  "$root/usr/share/doc/tactomo/examples"

echo "package"
mkdir "$root/DEBIAN"
install -m 755 deploy/debian/postinst deploy/debian/prerm deploy/debian/postrm "$root/DEBIAN"
size=$(du -sk "$root" | cut -f1)
sed "s/@VERSION@/$VERSION/; s/@ARCH@/$ARCH/; s/@PYTHON@/$PYTHON_PACKAGE/; s/@SIZE@/$size/" \
  deploy/debian/control > "$root/DEBIAN/control"
chmod -R u+rwX,go+rX,go-w "$root"
dpkg-deb --root-owner-group -Zzstd -z12 --build "$root" "dist/tactomo_${VERSION}_$ARCH.deb"
ls -lh "dist/tactomo_${VERSION}_$ARCH.deb"
