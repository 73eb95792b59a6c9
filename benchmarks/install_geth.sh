#!/usr/bin/env bash
# geth, built from its sources by Go's own tools (1.21 or later), for tests and measurements on private networks:
# 1.13.15, of the last line that signs Clique blocks (proof of authority), or 1.10.26, the last that also mines.
#   benchmarks/install_geth.sh .geth && export GETH="$PWD/.geth/geth"
#   benchmarks/install_geth.sh .geth-pow 1.10.26 && export GETH_POW="$PWD/.geth-pow/geth"
# About 90 s on two cores, 61 MB and what Go keeps of the sources.
set -euo pipefail
mkdir -p "${1:?usage: install_geth.sh FOLDER [VERSION]}"
place=$(cd "$1" && pwd)
# They name functions of Go's runtime that linkers from Go 1.23 on keep to themselves.
flags=-checklinkname=0
case "$(go env GOVERSION)" in go1.21*|go1.22*) flags= ;; esac
GOBIN="$place" GOFLAGS=-buildvcs=false go install -ldflags="$flags" github.com/ethereum/go-ethereum/cmd/geth@v${2:-1.13.15}
"$place/geth" version
