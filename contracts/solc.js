#!/usr/bin/env node
// npm's solc speaking as much of the native compiler's command line as py-solc-x uses:
// --version, and --standard-json with the request on stdin. (`solcjs` prints notices into its JSON.)
const solc = require(process.env.SOLC_JS || 'solc');
if (process.argv.includes('--version')) {
  console.log('solc, the solidity compiler commandline interface\nVersion: ' + solc.version());
} else if (process.argv.includes('--standard-json')) {
  process.stdout.write(solc.compile(require('fs').readFileSync(0, 'utf8')));
} else {
  throw new Error('only --version and --standard-json');
}
