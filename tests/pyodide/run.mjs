// smcrypto under Pyodide (CPython as WebAssembly, no OpenSSL):  npm install pyodide && node run.mjs REPOSITORY
// Copies the package and the vectors into its file system and runs check.py there.
import { loadPyodide } from "pyodide";
import fs from "fs";
import path from "path";

const root = process.argv[2];
const python = await loadPyodide();

function copy(from, to) {
  python.FS.mkdirTree(to);
  for (const name of fs.readdirSync(from)) {
    const source = path.join(from, name);
    if (name === "__pycache__") continue;
    if (fs.statSync(source).isDirectory()) copy(source, `${to}/${name}`);
    else python.FS.writeFile(`${to}/${name}`, fs.readFileSync(source));
  }
}

copy(`${root}/src/smcrypto`, "/lib/smcrypto");
copy(`${root}/tests/vectors/standards`, "/vectors");
copy(`${root}/tests/vectors/peers`, "/peers");
python.runPython(`import sys; sys.path.insert(0, "/lib")`);
console.log(python.runPython(fs.readFileSync(`${root}/tests/pyodide/check.py`, "utf-8")));
