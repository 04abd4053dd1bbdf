#!/bin/sh
# A small certificate authority: makes a key and a certificate for every participant of a deployment. Needs openssl
# 1.1.1 or later. See README.md, Access control.
#
#   sh make-ca.sh DIR ROLE-NAME[=HOST,...] ...
#
#   ROLE  router, node, driver, consumer, recorder, operator, bridge (neurove ros2) or ros (a node of ROS 2)
#   NAME  name of the node (its `node` setting), of the driver's stream, of the person or of the program
#   HOST  host names and addresses to which others connect: for a router, and for a node that listens itself
#
#   sh make-ca.sh pki router-box=192.168.7.1 node-edge1 driver-cam0 consumer-planner operator-alice
#
# Existing files are never overwritten, so the same command with one more name makes only the files of that name. The
# environment variables DAYS (730) and CA_DAYS (3650) set the days of validity. Anyone who has DIR/ca.key can make an
# operator certificate: do not keep DIR on a robot.
set -eu
umask 077

case ${1-} in
    "" | -*) sed -n '2,/^set/s/^# \{0,1\}//p' "$0"; exit 2 ;;
esac
dir=$1
shift
command -v openssl > /dev/null || { echo "make-ca.sh: openssl is not installed" >&2; exit 1; }

refuse() {
    echo "make-ca.sh: $1" >&2
    exit 2
}

# Zenoh searches for HOST in these names, as an address or as a DNS name.
names_of() {
    echo "$1" | tr ',' '\n' | while read -r host; do
        case $host in
            *:*) echo "IP:$host" ;;
            *[!0-9.]*) echo "DNS:$host" ;;
            *) echo "IP:$host" ;;
        esac
    done | paste -sd, -
}

# Check all names before any file is made.
for one in "$@"; do
    name=${one%%=*}
    echo "$name" | grep -Eq '^(router|node|driver|consumer|recorder|operator|bridge|ros)-[A-Za-z0-9_][A-Za-z0-9_.-]{0,51}$' ||
        refuse "'$name': give ROLE-NAME (router, node, driver, consumer, recorder, operator, bridge, ros; a name of up to 52 characters), such as node-edge1"
    case $one in
        *=*) echo "${one#*=}" | grep -Eq '^[A-Za-z0-9.:-]+(,[A-Za-z0-9.:-]+)*$' ||
            refuse "'$one': give hosts as names or addresses, separated by commas" ;;
        router-*) refuse "'$name': a router needs the hosts to which others connect: $name=192.168.7.1" ;;
    esac
    case $one in
        router-*=* | node-*=*) ;;
        *=*) refuse "'$one': only a router or a node listens; give $name without hosts" ;;
    esac
done

mkdir -p "$dir"
[ -e "$dir/ca.key" ] || [ ! -e "$dir/ca.crt" ] || refuse "$dir/ca.key is not here: the script cannot sign without it"
if [ ! -e "$dir/ca.key" ] && [ ! -e "$dir/ca.crt" ]; then
    openssl ecparam -name prime256v1 -genkey -noout -out "$dir/ca.key"
    openssl req -x509 -new -sha256 -key "$dir/ca.key" -days "${CA_DAYS:-3650}" -subj "/CN=neurove-ca" \
        -out "$dir/ca.crt" -addext "keyUsage=critical,keyCertSign,cRLSign"
    echo "made $dir/ca.crt: certificate of the authority; keep its key here"
fi

for one in "$@"; do
    name=${one%%=*}
    if [ -e "$dir/$name.key" ] || [ -e "$dir/$name.crt" ]; then
        echo "kept $dir/$name.crt"
        continue
    fi
    # A certificate without serverAuth does not let its holder act as a router.
    extensions="basicConstraints=critical,CA:false
keyUsage=critical,digitalSignature
extendedKeyUsage=clientAuth
subjectAltName=DNS:$name"
    case $one in
        *=*) extensions="basicConstraints=critical,CA:false
keyUsage=critical,digitalSignature
extendedKeyUsage=clientAuth,serverAuth
subjectAltName=$(names_of "${one#*=}")" ;;
    esac
    # Files get temporary names first: an interruption leaves no partial certificate, and the next run completes it.
    openssl ecparam -name prime256v1 -genkey -noout | openssl pkcs8 -topk8 -nocrypt -out "$dir/.$name.key"
    openssl req -new -sha256 -key "$dir/.$name.key" -subj "/CN=$name" -out "$dir/.$name.csr"
    echo "$extensions" > "$dir/.$name.ext"
    openssl x509 -req -sha256 -in "$dir/.$name.csr" -CA "$dir/ca.crt" -CAkey "$dir/ca.key" \
        -set_serial "0x$(openssl rand -hex 16)" -days "${DAYS:-730}" -extfile "$dir/.$name.ext" \
        -out "$dir/.$name.crt" 2> /dev/null
    mv "$dir/.$name.key" "$dir/$name.key"
    mv "$dir/.$name.crt" "$dir/$name.crt"
    rm "$dir/.$name.csr" "$dir/.$name.ext"
    echo "made $dir/$name.crt"
done
