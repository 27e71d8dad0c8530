#!/bin/sh
# sh secrets.sh CERTS: creates the Secrets from the folder of `zsim certs init`. This file contains no secrets.
set -eu
certs=$${1:?"usage: sh secrets.sh CERTS, the folder of zsim certs init"}
put() {
    kubectl -n $space create secret generic "$$@" --dry-run=client -o yaml | kubectl apply -f -
}
$puts
