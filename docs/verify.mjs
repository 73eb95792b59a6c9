// Reads a robot's log from a chain and proves it, independently of the bridge's Python: written from docs/log.md alone, on
// ethers (the chain), sm-crypto-v2 (SM2, SM3, SM4) and fzstd (Zstandard). What it has in common with the page of evidence
// (certificates, header, signature, lines) is in evidence.js.
//
//   npm ci && node verify.mjs --node URL --contract ADDRESS --robot NAME --ca ca.crt.pem [--key HEX]
//
// It does what docs/reading.md and docs/log.md say of one reading at one node. It leaves what outlives a reading or needs
// more than one node: bookmarks (so no `rolled-back` and `new-certificate`), the comparison of nodes
// (`contradicted`), grants that another reader made, and whether the chain was reorganised meanwhile.
//
// --key is the reader's private encryption key, 32 bytes in hex; without it everything but the content is checked. It is
//   sm2.PrivateKey.from_pem(open("enc.key.pem", "rb").read(), password=b"…").to_bytes().hex() in smcrypto.
// Proven records go to stdout as JSON lines, the verdict as one JSON object to stderr. Exit code 0: sound; 9: not.

import { readFileSync } from 'node:fs'
import { parseArgs } from 'node:util'
import { Contract, JsonRpcProvider, id as keccakOfText, getBytes, keccak256 } from 'ethers'
import { Decompress } from 'fzstd'
import { sm2, sm3, sm4 } from 'sm-crypto-v2'
import evidence from '../src/rosbridge_eth/reading/evidence.js'

const { big, certificate, chunkOf, element, hex, isSigned, join, lineOf, signer, word } = evidence
const ABI = [
  `function standings(bytes32[] Tks) view returns (tuple(address account, bytes32 certificatesHash, bool revoked,
     uint256 chunks, bytes32 tail, uint256 balance, uint256 dataBlock, uint256 changedBlock)[])`,
  'event Data(bytes32 indexed Tk, uint256 indexed first, address indexed account, uint256 previousBlock, bytes[] chunks)',
  `event Registered(bytes32 indexed Tk, address indexed account, uint256 index, uint256 previousBlock,
     bytes certificates)`,
  'event Revoked(bytes32 indexed Tk, address indexed account, uint256 index, uint256 previousBlock)',
]
const SPAN = 2000 // blocks asked for at once
const MAX = { plaintext: 4 << 20, block: 128 << 10 }
const ZEROS = '00'.repeat(32)

const text = new TextEncoder()
const digest = (...parts) => getBytes('0x' + sm3(join(...parts)))
const hmac = (key, data) => getBytes('0x' + sm3(data, { key: hex(key) }))
// JSON text without what acts on a terminal; the same JSON.
const printable = (json) =>
  json.replace(/[\u007f-\u009f\u200b-\u200f\u2028-\u202e\u2060-\u206f]/g,
    (char) => '\\u' + char.charCodeAt(0).toString(16).padStart(4, '0'))

class Wrong extends Error {
  constructor(kind, detail = '') {
    super(detail)
    this.kind = kind
  }
}
// What evidence.js makes of foreign bytes, or that they are wrong in this way.
const read = (kind, make) => {
  try {
    return make()
  } catch (error) {
    throw new Wrong(kind, error.message)
  }
}

// --- chunks

function root(leaves) {
  let level = leaves
  while (level.length > 1) {
    const above = []
    for (let n = 0; n + 1 < level.length; n += 2) above.push(digest([1], level[n], level[n + 1]))
    level = level.length % 2 ? [...above, level.at(-1)] : above
  }
  return hex(level[0])
}

// The first grant that decrypts. C1 | C3 | C2, GB/T 32918.4; the library wants C1 without its leading 04.
function contentKey(grants, readerKey) {
  for (const wrapped of grants) {
    try {
      const key = wrapped[0] === 4 && sm2.doDecrypt(hex(wrapped.slice(1)), readerKey, 1, { output: 'array' })
      if (key.length === 16) return key
    } catch {} // C1 is no point
  }
}
const expanded = (key, label) => hmac(key, join(text.encode(`rosbridge-eth/3 ${label}`), [1])) // HKDF-Expand, RFC 5869

function open(chunk, log, readerKey) {
  if (chunk.records === 0) return []
  const key = contentKey(chunk.grants, readerKey)
  if (!key) throw new Wrong('no-grant')
  const lines = read('unopenable', () => {
    const plaintext = sm4.decrypt(chunk.body.slice(0, -16), expanded(key, 'body').slice(0, 16), {
      mode: 'gcm', iv: new Uint8Array(12), associatedData: join(log, chunk.place), tag: chunk.body.slice(-16), output: 'array',
    })
    const content = unpacked(plaintext)
    if (content.at(-1) !== 10 || content[0] === 10 || content.includes('\n\n')) throw new Error('an empty record')
    const found = []
    for (let at = 0, end; at < content.length; at = end + 1) found.push(content.subarray(at, (end = content.indexOf(10, at))))
    return found
  })
  if (lines.length !== chunk.records) throw new Wrong('unopenable', 'another number of records')
  const saltKey = expanded(key, 'salts')
  const leaves = lines.map((line, n) => digest([0], hmac(saltKey, word(n, 4)).slice(0, 16), line))
  if (root(leaves) !== hex(chunk.root)) throw new Wrong('unopenable', 'another root')
  return lines
}

// What the Zstandard frame holds (RFC 8878, 3.1.1), with zeros up to 64 bytes behind it. Its header has one form, so its size
// and its window are known before anything is unpacked. Where it ends its blocks say.
function unpacked(data) {
  const little = (at, length) => Number(big(data.slice(at, at + length).reverse()))
  const size = little(5, 4)
  if (hex(data.slice(0, 5)) !== '28b52ffda0' || size > MAX.plaintext) throw new Error('no frame in the one form')
  let end = 9
  for (let last = 0; !last;) {
    if (end + 3 > data.length) throw new Error('the frame has no end')
    const [block, kind] = [little(end, 3) >> 3, (data[end] >> 1) & 3]
    last = data[end] & 1
    if (kind === 3 || block > Math.min(size, MAX.block)) throw new Error('no block')
    end += 3 + (kind === 1 ? 1 : block)
  }
  const padding = data.slice(end)
  if (end > data.length || padding.length >= 64 || padding.some((byte) => byte)) throw new Error('no padding')
  const parts = []
  let total = 0
  new Decompress((part) => {
    total += part.length
    if (total > size) throw new Error('another size')
    parts.push(Buffer.from(part))
  }).push(data.slice(0, end), true)
  if (total !== size) throw new Error('another size')
  return Buffer.concat(parts)
}

// --- the reading

const { values: options } = parseArgs({
  options: Object.fromEntries(['node', 'contract', 'robot', 'ca', 'key'].map((name) => [name, { type: 'string' }])),
})
const wanted = ['node', 'contract', 'robot', 'ca'].filter((name) => !options[name])
if (wanted.length) {
  console.error(`give ${wanted.map((name) => `--${name}`).join(', ')}, as the head of this file says`)
  process.exit(2)
}
const provider = new JsonRpcProvider(options.node, undefined, { staticNetwork: true })
const contract = new Contract(options.contract, ABI, provider)
const { chainId } = await provider.getNetwork()
const genesis = (await provider.getBlock(0)).hash
const tk = keccakOfText(options.robot)
const log = join(digest(word(chainId), getBytes(genesis), getBytes(options.contract)), getBytes(tk))
const block = await provider.getBlockNumber()
const [standing] = await contract.standings([tk], { blockTag: block })
const end = Number(standing.chunks)

const findings = []
const told = (kind, chunk, detail = '', count = 1) => findings.push({ kind, chunk, count, detail })
const NOTICES = new Set(['dropped', 'lost', 'triggered', 'restarted', 'no-grant', 'clock'])
const times = new Map()
const timeOf = async (n) => {
  if (!times.has(n)) times.set(n, (await provider.getBlock(n)).timestamp)
  return times.get(n)
}
const eventsIn = async (names, from, to) => {
  const found = []
  for (const name of names) found.push(...(await contract.queryFilter(contract.filters[name](tk), from, to)))
  return found.sort((a, b) => a.blockNumber - b.blockNumber || a.index - b.index)
}

// The first of two values, or all that there is where it is not two.
function firstOf(certificates) {
  try {
    const { whole } = element(certificates)
    return whole.length + element(certificates, whole.length).whole.length === certificates.length ? whole : certificates
  } catch {
    return certificates
  }
}

// Registrations, from the newest back by their links.
const roots = readFileSync(options.ca, 'latin1').match(/-----BEGIN CERTIFICATE-----[^-]+/g)
  .map((pem) => certificate(new Uint8Array(Buffer.from(pem.replace(/-----[^-]+-----|\s/g, ''), 'base64'))))
const registrations = []
for (let at = Number(standing.changedBlock); at > 0;) {
  const found = await eventsIn(['Registered', 'Revoked'], at, at)
  if (!found.length) throw new Error(`the node shows no registration in block ${at}`)
  registrations.unshift(...found)
  at = Number(found[0].args.previousBlock)
}
// The node cannot leave one out: they are linked, and the contract has the hash of the newest certificates.
let linked = { block: 0, index: 0, hash: '0x' + ZEROS, revoked: false }
let whole = true
for (const { args, blockNumber, eventName } of registrations) {
  whole &&= Number(args.previousBlock) === linked.block && Number(args.index) >= linked.index
  const revoked = eventName === 'Revoked'
  const hash = revoked ? linked.hash : keccak256(args.certificates)
  linked = { block: blockNumber, index: Number(args.index), hash, revoked }
}
whole &&= linked.hash === standing.certificatesHash && linked.revoked === standing.revoked
if (!whole || linked.block !== Number(standing.changedBlock)) told('withheld', end, 'a registration')
const signers = []
for (const event of registrations) {
  const one = { index: Number(event.args.index), block: event.blockNumber, revoked: event.eventName === 'Revoked', fingerprint: '' }
  if (!one.revoked) {
    const certificates = getBytes(event.args.certificates)
    one.fingerprint = hex(digest(firstOf(certificates)))
    try {
      Object.assign(one, signer(certificates, roots, options.robot, 1000 * (await timeOf(event.blockNumber))))
    } catch (error) {
      one.why = error.message
    }
  }
  signers.push(one)
}

// One pass over the chunks. head is the robot's newest; seen the digests of all, to tell a fork from a hole.
let head = null
let records = 0
const seen = new Set()
const withoutBody = new Set() // of which only the dropped form was read

function follow(chunk, at) {
  const same = head !== null && chunk.stream === head.stream
  const ahead = chunk.number - (same ? head.number + 1n : 0n)
  const follows = chunk.previous === (head === null ? ZEROS : head.digest)
  const knowsNone = !same && chunk.number === 0n && chunk.previous === ZEROS
  const goesBack = head !== null && (same ? head.goodbye : chunk.stream < head.stream)
  if (seen.has(chunk.digest)) throw new Wrong('forked', 'a chunk that was read before, once more')
  if (ahead !== 0n || goesBack || !(follows || knowsNone)) {
    if (goesBack || seen.has(chunk.previous) || (same && ahead <= 0n)) told('forked', at)
    else told('missing', at, '', Number(ahead) || 1)
  }
  if (head !== null && !same && (knowsNone || !head.goodbye)) told('restarted', at)
  if (head !== null && chunk.sealed < head.sealed - 1000) told('clock', at, 'sealed before the chunk it follows')
  seen.add(chunk.digest)
  head = chunk
}

async function prove(data, at, event) {
  const chunk = read('malformed', () => chunkOf(data))
  const governing = signers.findLast((one) => one.index <= at)
  if (!governing?.key) throw new Wrong('untrusted', governing?.why ?? (governing ? 'revoked' : 'not registered'))
  if (!isSigned(chunk, log, governing.key)) throw new Wrong('forged')
  if (chunk.sealed > governing.until) throw new Wrong('untrusted', "sealed after the certificate's end")
  const time = await timeOf(event.blockNumber)
  const altered = !chunk.bare && chunk.body.length > 0 && hex(digest(chunk.body)) !== chunk.bodyDigest
  const restored = !chunk.bare && !altered && chunk.previous !== head?.digest && withoutBody.delete(chunk.digest)
  if (!restored) {
    follow(chunk, at)
    if (chunk.bare) withoutBody.add(chunk.digest)
    if (chunk.sealed > time * 1000 + 300000) told('clock', at, 'sealed later than its block')
    if (chunk.sealed < governing.from) told('clock', at, "sealed before the robot's certificate began")
  }
  if (chunk.bare) return told('dropped', at, '', chunk.records)
  if (altered) throw new Wrong('altered')
  if (!options.key) return chunk.records && told('no-grant', at, '', chunk.records)
  let unsynchronised = 0
  for (const [n, line] of open(chunk, log, options.key).entries()) {
    let found
    const shown = line.toString('utf8')
    try {
      if (!Buffer.from(shown).equals(line)) throw new Error('it is not UTF-8')
      found = lineOf(shown)
    } catch (error) {
      told('unopenable', at, `line ${n}: ${error.message}`)
      continue
    }
    if (found.kind === 'lost') told('lost', at, '', Number(found.content.lost))
    if (found.kind === 'trigger') told('triggered', at)
    if (found.kind !== 'message') continue
    unsynchronised += !found.content.clock
    const proof = {
      chunk: at, record: n, stream: chunk.stream, number: Number(chunk.number), digest: chunk.digest,
      sealed: new Date(chunk.sealed).toISOString(), block: event.blockNumber,
      block_time: new Date(time * 1000).toISOString(), transaction: event.transactionHash,
    }
    // The line itself and not what was parsed of it: JavaScript's numbers would lose digits of the times.
    process.stdout.write(`${printable(shown).slice(0, -1)},"proof":${JSON.stringify(proof)}}\n`)
    records += 1
  }
  if (unsynchronised) told('clock', at, 'messages captured while it was not synchronised', unsynchronised)
}

let next = 0
let last = null
for (let from = registrations[0]?.blockNumber ?? 0; from <= Number(standing.dataBlock); from += SPAN) {
  for (const event of await eventsIn(['Data'], from, Math.min(from + SPAN - 1, Number(standing.dataBlock)))) {
    const first = Number(event.args.first)
    if (first > next) told('withheld', next, `up to ${first - 1}`, first - next)
    for (const [n, encoded] of event.args.chunks.entries()) {
      const at = first + n
      if (at < next || at >= end) continue
      next = at + 1
      last = encoded
      try {
        await prove(getBytes(encoded), at, event)
      } catch (error) {
        if (!(error instanceof Wrong)) throw error
        told(error.kind, at, error.message, error.kind === 'no-grant' ? chunkOf(getBytes(encoded)).records : 1)
      }
    }
  }
}
if (next < end) told('withheld', next, `up to ${end - 1}`, end - next)
else if (last !== null && keccak256(last) !== standing.tail) told('altered', end - 1, 'the contract has another hash')

const sound = findings.every((finding) => NOTICES.has(finding.kind))
const counts = {}
for (const { kind, count } of findings) counts[kind] = (counts[kind] ?? 0) + count
const verdict = {
  robot: options.robot, sound, chunks: end, block, records, counts,
  head: head && { stream: head.stream, number: Number(head.number), digest: head.digest, sealed: head.sealed, goodbye: head.goodbye },
  certificates: signers.map(({ index, revoked, fingerprint, key }) => ({ index, revoked, fingerprint, trusted: Boolean(key) })),
  findings,
}
process.stderr.write(JSON.stringify(verdict) + '\n')
provider.destroy()
process.exitCode = sound ? 0 : 9
