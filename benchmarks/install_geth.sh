#!/usr/bin/env bash
# geth 1.13.15, the last line of geth that signs Clique blocks, built from its sources by Go's own tools (1.21 or later):
# for the tests and measurements on a network with proof of authority.
#   benchmarks/install_geth.sh .geth && export GETH="$PWD/.geth/geth"
# About 90 s on two cores, 61 MB and what Go keeps of the sources.
set -euo pipefail
mkdir -p "${1:?usage: install_geth.sh FOLDER}"
place=$(cd "$1" && pwd)
# geth 1.13 names functions of Go's runtime that linkers from Go 1.23 on keep to themselves.
flags=-checklinkname=0
case "$(go env GOVERSION)" in go1.21*|go1.22*) flags= ;; esac
GOBIN="$place" GOFLAGS=-buildvcs=false go install -ldflags="$flags" github.com/ethereum/go-ethereum/cmd/geth@v1.13.15
"$place/geth" version
