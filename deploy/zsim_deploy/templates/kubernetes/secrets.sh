#!/bin/sh
# sh secrets.sh CERTS: makes the Secrets from the folder of `zsim certs init`; this file contains none of them.
set -eu
certs=$${1:?"usage: sh secrets.sh CERTS, the folder of zsim certs init"}
put() {
    kubectl -n $space create secret generic "$$@" --dry-run=client -o yaml | kubectl apply -f -
}
$puts
