#!/bin/sh
# A small certificate authority: one key and certificate for every participant of a deployment. Needs openssl 1.1.1 or
# later. See README.md, Who may.
#
#   sh make-ca.sh DIR ROLE-NAME[=HOST,...] ...
#
#   ROLE  router, node, driver, consumer, recorder or operator
#   NAME  of the node (its `node` setting), of the driver's stream, of the person or program
#   HOST  names and addresses that others connect to: for a router, and for a node that listens itself
#
#   sh make-ca.sh pki router-box=192.168.7.1 node-edge1 driver-cam0 consumer-planner operator-alice
#
# What is there is never written over, so the same line with a name more makes that name alone. Days of validity: DAYS
# (730) and CA_DAYS (3650). Whoever has DIR/ca.key can make an operator: keep DIR off the robots.
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

# Zenoh looks for HOST among these names, as address or as DNS name.
names_of() {
    echo "$1" | tr ',' '\n' | while read -r host; do
        case $host in
            *:*) echo "IP:$host" ;;
            *[!0-9.]*) echo "DNS:$host" ;;
            *) echo "IP:$host" ;;
        esac
    done | paste -sd, -
}

# All names are looked at before anything is made.
for one in "$@"; do
    name=${one%%=*}
    echo "$name" | grep -Eq '^(router|node|driver|consumer|recorder|operator)-[A-Za-z0-9_][A-Za-z0-9_.-]{0,51}$' ||
        refuse "'$name': give ROLE-NAME (router, node, driver, consumer, recorder, operator; a name of up to 52 characters), such as node-edge1"
    case $one in
        *=*) echo "${one#*=}" | grep -Eq '^[A-Za-z0-9.:-]+(,[A-Za-z0-9.:-]+)*$' ||
            refuse "'$one': give hosts as names or addresses, joined by commas" ;;
        router-*) refuse "'$name': a router needs the hosts that others connect to: $name=192.168.7.1" ;;
    esac
    case $one in
        router-*=* | node-*=*) ;;
        *=*) refuse "'$one': only a router or a node listens; give $name without hosts" ;;
    esac
done

mkdir -p "$dir"
[ -e "$dir/ca.key" ] || [ ! -e "$dir/ca.crt" ] || refuse "$dir/ca.key is not here: nothing can be signed without it"
if [ ! -e "$dir/ca.key" ] && [ ! -e "$dir/ca.crt" ]; then
    openssl ecparam -name prime256v1 -genkey -noout -out "$dir/ca.key"
    openssl req -x509 -new -sha256 -key "$dir/ca.key" -days "${CA_DAYS:-3650}" -subj "/CN=neurove-ca" \
        -out "$dir/ca.crt" -addext "keyUsage=critical,keyCertSign,cRLSign"
    echo "made $dir/ca.crt: the authority; its key stays here"
fi

for one in "$@"; do
    name=${one%%=*}
    if [ -e "$dir/$name.key" ] || [ -e "$dir/$name.crt" ]; then
        echo "kept $dir/$name.crt"
        continue
    fi
    # A certificate without serverAuth can not pass for a router, whoever holds it.
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
    # Made under other names first: a cut leaves no half certificate, and the next run makes it whole.
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
