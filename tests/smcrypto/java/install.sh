#!/usr/bin/env bash
# Bouncy Castle, fetched by Maven, and the tests' program compiled with it, into FOLDER: what BOUNCY_CASTLE is to name.
set -euo pipefail
mkdir -p "${1:?usage: install.sh FOLDER}"
folder=$(cd "$1" && pwd)
cd "$(dirname "$0")"
mvn -q -B org.apache.maven.plugins:maven-dependency-plugin:3.6.1:copy-dependencies -DoutputDirectory="$folder"
javac -cp "$folder/*" -d "$folder" BouncyCastle.java
