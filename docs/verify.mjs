// Reads a robot's log from a chain and proves it, independently of rosbridge_eth: written from docs/log.md alone,
// on ethers (the chain), sm-crypto-v2 (SM2, SM3, SM4) and fzstd (Zstandard).
//
//   npm ci && node verify.mjs --node URL --contract ADDRESS --robot NAME --ca ca.crt.pem [--key HEX]
//
// It does what docs/reading.md and docs/log.md say of one reading at one node. It leaves what outlives a reading or needs
// more than one node: bookmarks (so no `rolled-back`, `elsewhere` and `new-certificate`), the comparison of nodes
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

const ABI = [
  `function standings(bytes32[] Tks) view returns (tuple(address account, bytes32 certificatesHash, bool revoked,
     uint256 chunks, bytes32 tail, uint256 balance, uint256 dataBlock, uint256 changedBlock)[])`,
  'event Data(bytes32 indexed Tk, uint256 indexed first, address indexed account, uint256 previousBlock, bytes[] chunks)',
  `event Registered(bytes32 indexed Tk, address indexed account, uint256 index, uint256 previousBlock,
     bytes certificates)`,
  'event Revoked(bytes32 indexed Tk, address indexed account, uint256 index, uint256 previousBlock)',
]
const SPAN = 2000 // blocks asked for at once
const MAX = { body: 65536, readers: 16, records: 1000, plaintext: 4 << 20, line: 60 << 10, depth: 100, block: 128 << 10 }
const FIXED = 1 + 1 + 16 + 8 + 32 + 8 + 4 + 32 + 4 + 32 + 1
const GRANT = 113
const ZEROS = '00'.repeat(32)

const text = new TextEncoder()
const hex = (bytes) => Buffer.from(bytes).toString('hex')
const join = (...parts) => new Uint8Array(Buffer.concat(parts.map((part) => Buffer.from(part))))
const digest = (...parts) => getBytes('0x' + sm3(join(...parts)))
const hmac = (key, data) => getBytes('0x' + sm3(data, { key: hex(key) }))
const bigEndian = (number, size) => getBytes('0x' + BigInt(number).toString(16).padStart(2 * size, '0'))
// JSON text without what acts on a terminal; the same JSON.
const printable = (json) =>
  json.replace(/[\u007f-\u009f\u200b-\u200f\u2028-\u202e\u2060-\u206f]/g,
    (char) => '\\u' + char.charCodeAt(0).toString(16).padStart(4, '0'))
const number = (bytes) => BigInt('0x' + (hex(bytes) || '0'))
const holds = (key, message, signature, der) => {
  try {
    return sm2.doVerifySignature(message, hex(signature), key, { hash: true, der })
  } catch {
    return false // not even in the form of a signature
  }
}

class Wrong extends Error {
  constructor(kind, detail = '') {
    super(detail)
    this.kind = kind
  }
}

// --- X.509 (RFC 5280), as far as it is needed

// One value. DER's lengths have one form (X.690, 10.1).
function element(der, at) {
  let length = der[at + 1]
  let start = at + 2
  if (length >= 0x80) {
    start += length & 0x7f
    const size = der.slice(at + 2, start)
    if (size.length < 1 || size.length > 3 || size[0] === 0) throw new Wrong('untrusted', 'a certificate is not DER')
    length = Number(number(size))
    if (length < 0x80) throw new Wrong('untrusted', 'a certificate is not DER')
  }
  const end = start + length
  if (!(end <= der.length)) throw new Wrong('untrusted', 'a certificate ends early')
  return { tag: der[at], whole: der.slice(at, end), content: der.slice(start, end), end }
}

function members(content) {
  const found = []
  for (let at = 0; at < content.length; at = found.at(-1).end) found.push(element(content, at))
  return found
}

const SM2_WITH_SM3 = '06082a811ccf55018375'
const SM2_KEY = '301306072a8648ce3d020106082a811ccf5501822d'
const HARMLESS = new Set(['551d0e', '551d20', '551d23']) // identifiers of keys, and policies: any is taken
const bits = (part) => part.content.slice(1)

function certificate(der) {
  const [signed, algorithm, signature] = members(element(der, 0).content)
  const [version, , inner, issuer, validity, subject, keyInfo, ...rest] = members(signed.content)
  if (version.tag !== 0xa0 || hex(version.content) !== '020102') throw new Wrong('untrusted', 'not of version 3')
  const [kind, point] = members(keyInfo.content)
  const sm2Alone = [algorithm, inner].every((used) => hex(members(used.content)[0].whole) === SM2_WITH_SM3)
  if (!sm2Alone || hex(kind.whole) !== SM2_KEY) throw new Wrong('untrusted', 'not of SM2 and SM3')
  const [from, until] = members(validity.content).map(({ tag, content }) => {
    const t = Buffer.from(content).toString('latin1')
    const full = tag === 0x17 ? (t < '50' ? '20' : '19') + t : t
    return Date.parse(full.replace(/^(....)(..)(..)(..)(..)(..)Z$/, '$1-$2-$3T$4:$5:$6Z'))
  })
  const found = {
    signed: signed.whole, signature: bits(signature), issuer: hex(issuer.whole), subject: hex(subject.whole),
    key: hex(bits(point)), from, until, names: [], authority: false, usage: null, size: element(der, 0).end,
  }
  const there = new Set()
  for (const { content } of rest.filter((part) => part.tag === 0xa3)) {
    for (const extension of members(members(content)[0].content)) {
      const parts = members(extension.content)
      const [id, value] = [hex(parts[0].content), element(parts.at(-1).content, 0)]
      if (there.has(id)) throw new Wrong('untrusted', 'an extension is there twice')
      there.add(id)
      if (id === '551d13') found.authority = members(value.content).some((part) => part.tag === 1 && part.content[0])
      else if (id === '551d0f') found.usage = bits(value)[0] // digitalSignature 80, nonRepudiation 40 … keyAgreement 08, keyCertSign 04
      else if (id === '551d11') {
        for (const name of members(value.content)) {
          found.names.push(`${name.tag & 0x1f}:${Buffer.from(name.content).toString('latin1')}`)
        }
      } else if (!HARMLESS.has(id) && parts.length > 2 && parts[1].content[0]) {
        throw new Wrong('untrusted', `a critical extension, ${id}`)
      }
    }
  }
  found.constrained = there.has('551d1e') // nameConstraints
  found.purposes = there.has('551d25') // extendedKeyUsage
  return found
}

// The first of two values, or all that there is where it is not two.
function firstOf(certificates) {
  try {
    const { whole, end } = element(certificates, 0)
    return element(certificates, end).end === certificates.length ? whole : certificates
  } catch {
    return certificates
  }
}

// The signing certificate of a registration, if the table of log.md (Certificates) holds for both and they had not ended
// then. That they begin later than its block is a chain whose clock is behind.
function signer(certificates, roots, robot, blockTime) {
  const first = certificate(certificates)
  const second = certificate(certificates.slice(first.size))
  if (first.size + second.size !== certificates.length) throw new Wrong('untrusted', 'not two certificates')
  const at = Math.max(blockTime * 1000, first.from, second.from)
  const until = Math.min(first.until, second.until)
  if (!(at <= until)) throw new Wrong('untrusted', 'had ended when they were registered')
  for (const [made, own, others] of [[first, 0xc0, 0x38], [second, 0x08, 0xc0]]) {
    const issued = (root) => root.subject === made.issuer && root.authority && !root.constrained &&
      root.from <= at && at <= root.until && (root.usage === null || root.usage & 0x04) &&
      holds(root.key, made.signed, made.signature, true)
    if (!roots.some(issued)) throw new Wrong('untrusted', 'not signed by the CA')
    if (made.names.join() !== `6:urn:rosbridge-eth:robot:${robot}`) throw new Wrong('untrusted', `for ${made.names}`)
    if ((made.usage & own) !== own || made.usage & others || made.purposes) throw new Wrong('untrusted', 'for another use')
    if (made.authority) throw new Wrong('untrusted', 'a CA itself')
  }
  return { ...first, from: Math.max(first.from, second.from), until }
}

// --- chunks

function parse(data) {
  if (data.length < FIXED + 64) throw new Wrong('malformed', `${data.length} bytes`)
  let at = 0
  const take = (size) => data.slice(at, (at += size))
  const [version, flags] = take(2)
  const header = {
    goodbye: flags === 1, stream: take(16), number: number(take(8)), previous: hex(take(32)),
    sealed: Number(number(take(8))), records: Number(number(take(4))), root: hex(take(32)),
    bodyLength: Number(number(take(4))), bodyDigest: hex(take(32)), grants: [],
  }
  const [count] = take(1)
  for (let n = 0; n < count; n++) header.grants.push(take(GRANT))
  header.encoded = data.slice(0, at)
  header.digest = hex(digest(header.encoded))
  const signature = take(64)
  const body = data.slice(at)
  const empty = header.records === 0
  const formed = version === 3 && flags <= 1 && signature.length === 64 && header.sealed < 253402300800000 &&
    (body.length === 0 || body.length === header.bodyLength) && (empty
    ? header.bodyLength === 0 && count === 0 && header.root === hex(digest()) && header.bodyDigest === hex(digest())
    : header.records <= MAX.records && count >= 1 && count <= MAX.readers && header.bodyLength > 16 &&
      header.bodyLength <= MAX.body && (header.bodyLength - 16) % 64 === 0)
  if (!formed) throw new Wrong('malformed')
  return { header, signature, body, bare: header.bodyLength > 0 && body.length === 0 }
}

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

function open({ header, body }, log, readerKey) {
  if (header.records === 0) return []
  const place = join(header.stream, bigEndian(header.number, 8))
  const key = contentKey(header.grants, readerKey)
  if (!key) throw new Wrong('no-grant')
  let lines
  try {
    const plaintext = sm4.decrypt(body.slice(0, -16), expanded(key, 'body').slice(0, 16), {
      mode: 'gcm', iv: new Uint8Array(12), associatedData: join(log, place), tag: body.slice(-16), output: 'array',
    })
    const content = unpacked(plaintext)
    if (content.at(-1) !== 10 || content[0] === 10 || content.includes('\n\n')) throw new Error('an empty record')
    lines = []
    for (let at = 0, end; at < content.length; at = end + 1) lines.push(content.subarray(at, (end = content.indexOf(10, at))))
  } catch (error) {
    throw new Wrong('unopenable', error.message)
  }
  if (lines.length !== header.records) throw new Wrong('unopenable', 'another number of records')
  const saltKey = expanded(key, 'salts')
  const salt = (n) => hmac(saltKey, bigEndian(n, 4)).slice(0, 16)
  const found = root(lines.map((line, n) => digest([0], salt(n), line)))
  if (found !== header.root) throw new Wrong('unopenable', 'another root')
  return lines
}

// What one Zstandard frame holds (RFC 8878, 3.1.1), with zeros up to 64 bytes behind it: within 4 MiB of window and content,
// without a dictionary, of the size and with the checksum that it says it has. Where it ends its blocks say.
function unpacked(data) {
  if (hex(data.slice(0, 4)) !== '28b52ffd') throw new Error('no frame')
  const descriptor = data[4]
  const [single, checked, size] = [(descriptor >> 5) & 1, (descriptor >> 2) & 1, [0, 2, 4, 8][descriptor >> 6]]
  if (descriptor & 8) throw new Error('a reserved bit')
  const little = (from, length) => number(data.slice(from, from + length).reverse())
  let at = 5
  const [exponent, mantissa] = single ? [0, 0] : [10 + (data[at] >> 3), data[at++] & 7]
  let window = 2 ** exponent * (1 + mantissa / 8)
  const dictionary = [0, 1, 2, 4][descriptor & 3]
  if (dictionary && little(at, dictionary)) throw new Error('a dictionary')
  at += dictionary
  const sizes = size || single
  const length = Number(little(at, sizes)) + (size === 2 ? 256 : 0)
  at += sizes
  if (single) window = length
  if (window > MAX.plaintext) throw new Error('a window above 4 MiB')
  const most = Math.min(window, MAX.block)
  for (let last = 0; !last;) {
    if (at + 3 > data.length) throw new Error('the frame has no end')
    const [block, kind] = [Number(little(at, 3)) >> 3, (data[at] >> 1) & 3]
    last = data[at] & 1
    if (kind === 3 || block > most) throw new Error('no block')
    at += 3 + (kind === 1 ? 1 : block)
  }
  const end = at + (checked ? 4 : 0)
  const padding = data.slice(end)
  if (end > data.length || padding.length >= 64 || padding.some((byte) => byte)) throw new Error('no padding')
  const parts = []
  let total = 0
  new Decompress((part) => {
    total += part.length
    if (total > MAX.plaintext) throw new Error('more than 4 MiB')
    parts.push(Buffer.from(part))
  }).push(data.slice(0, end), true)
  const content = Buffer.concat(parts)
  if (sizes && content.length !== length) throw new Error('another size')
  if (checked && (xxh64(content) & 0xffffffffn) !== little(at, 4)) throw new Error('another checksum')
  return content
}

// XXH64 with seed 0 (xxHash, "XXH64 algorithm description"), of which a frame's checksum is the lower half.
function xxh64(data) {
  const [p1, p2, p3, p4, p5] = [
    0x9e3779b185ebca87n, 0xc2b2ae3d27d4eb4fn, 0x165667b19e3779f9n, 0x85ebca77c2b2ae63n, 0x27d4eb2f165667c5n]
  const u64 = (x) => BigInt.asUintN(64, x)
  const turn = (x, n) => u64((x << n) | (x >> (64n - n)))
  const round = (sum, lane) => u64(turn(u64(sum + lane * p2), 31n) * p1)
  let at = 0
  let hash = p5
  if (data.length >= 32) {
    const v = [u64(p1 + p2), p2, 0n, u64(-p1)]
    for (; at + 32 <= data.length; at += 32) v.forEach((one, n) => (v[n] = round(one, data.readBigUInt64LE(at + 8 * n))))
    hash = u64(turn(v[0], 1n) + turn(v[1], 7n) + turn(v[2], 12n) + turn(v[3], 18n))
    for (const one of v) hash = u64((hash ^ round(0n, one)) * p1 + p4)
  }
  hash = u64(hash + BigInt(data.length))
  for (; at + 8 <= data.length; at += 8) hash = u64(turn(hash ^ round(0n, data.readBigUInt64LE(at)), 27n) * p1 + p4)
  for (; at + 4 <= data.length; at += 4) hash = u64(turn(hash ^ u64(BigInt(data.readUInt32LE(at)) * p1), 23n) * p2 + p3)
  for (; at < data.length; at++) hash = u64(turn(hash ^ u64(BigInt(data[at]) * p5), 11n) * p1)
  hash = u64((hash ^ (hash >> 33n)) * p2)
  hash = u64((hash ^ (hash >> 29n)) * p3)
  return hash ^ (hash >> 32n)
}

// --- lines

const STRING = String.raw`"[^"\\]*(?:\\.[^"\\]*)*"`
const COUNT = String.raw`-?\d+`
const FORMS = {
  message: `{"topic":${STRING},"type":${STRING},"source":${STRING},"received_ns":${COUNT},"captured_ns":${COUNT},` +
    '"clock":(true|false),"data":{.*}}',
  type: `{"type":${STRING},"wire":${STRING},"format":${STRING},"definition":${STRING}}`,
  lost: `{"lost":(${COUNT}),"topic":${STRING},"why":${STRING}}`,
  trigger: `{"trigger":${STRING},"why":${STRING},"at_ns":${COUNT}}`,
  stream: `{"stream":{"source":${STRING},"software":${STRING}}}`,
}
for (const kind in FORMS) FORMS[kind] = new RegExp(`^${FORMS[kind].replace(/[{}]/g, '\\$&')}$`, 's')
const TOKEN = new RegExp(`${STRING}|[-+.\\w]+|[^]`, 'g')

// Of which kind a line is, with what its form captures; an Error where it is not in its one form (docs/log.md, Records).
function kindOf(line) {
  const shown = line.toString('utf8')
  const form = (holds) => {
    if (!holds) throw new Error('not in the one form of a line')
  }
  form(line.length <= MAX.line && Buffer.from(shown).equals(line))
  const open = [] // of each level, an object's names, or null for an array
  const tokens = shown.match(TOKEN)
  for (const [n, token] of tokens.entries()) {
    if (token === '{' || token === '[') form(open.push(token === '{' ? new Set() : null) <= MAX.depth)
    else if (token === '}' || token === ']') open.pop()
    else if (token[0] === '"') {
      const said = JSON.parse(token)
      form(JSON.stringify(said) === token && !/\p{Cs}/u.test(said))
      if (tokens[n + 1] === ':') form(open.at(-1) && !open.at(-1).has(said) && open.at(-1).add(said))
    } else form(token.trim() && (!/[-\d]/.test(token[0]) || Number.isFinite(Number(token))))
  }
  const names = Object.keys(JSON.parse(shown)).join()
  for (const kind in FORMS) {
    const [match, captured] = FORMS[kind].exec(shown) ?? []
    if (!match || (kind === 'message' && names !== 'topic,type,source,received_ns,captured_ns,clock,data')) continue
    const counts = [...shown.matchAll(/"(?:received_ns|captured_ns|lost|at_ns)":(-?\d+)/g)]
    form(counts.slice(0, kind === 'message' ? 2 : 1).every(([, count]) => BigInt(count) >= 0n && BigInt(count) < 2n ** 63n))
    return { kind, captured, shown }
  }
  throw new Error('no line of these kinds')
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
const ledger = digest(bigEndian(chainId, 32), getBytes(genesis), getBytes(options.contract))
const log = join(ledger, getBytes(tk))
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
  const one = { index: Number(event.args.index), block: event.blockNumber, revoked: event.eventName === 'Revoked' }
  if (!one.revoked) {
    const certificates = getBytes(event.args.certificates)
    one.fingerprint = hex(digest(firstOf(certificates)))
    try {
      Object.assign(one, signer(certificates, roots, options.robot, await timeOf(event.blockNumber)))
    } catch (error) {
      one.why = error.message
    }
  }
  signers.push(one)
}

// One pass over the chunks. head is the robot's newest; seen the digests of all, to tell a fork from a hole.
let head = null
let records = 0
const seen = new Map()
const withoutBody = new Set() // of which only the dropped form was read

function follow(header, at) {
  const stream = hex(header.stream)
  const same = head !== null && stream === head.stream
  const ahead = header.number - (same ? head.number + 1n : 0n)
  const follows = header.previous === (head === null ? ZEROS : head.digest)
  const knowsNone = !same && header.number === 0n && header.previous === ZEROS
  if (seen.has(header.digest)) throw new Wrong('forked', `the chunk of index ${seen.get(header.digest)} once more`)
  if (ahead !== 0n || !(follows || knowsNone)) {
    if (seen.has(header.previous) || (same && ahead <= 0n)) told('forked', at)
    else told('missing', at, '', Number(ahead) || 1)
  }
  if (head !== null && !same && (knowsNone || !head.goodbye)) told('restarted', at)
  if (head !== null && header.sealed < head.sealed - 1000) told('clock', at, 'sealed before the chunk it follows')
  seen.set(header.digest, at)
  head = { stream, number: header.number, digest: header.digest, sealed: header.sealed, goodbye: header.goodbye }
}

async function prove(data, at, event) {
  const chunk = parse(data)
  const { header } = chunk
  const governing = signers.findLast((one) => one.index <= at)
  if (!governing?.key) throw new Wrong('untrusted', governing?.why ?? (governing ? 'revoked' : 'not registered'))
  const signed = join(text.encode(`rosbridge-eth/2 ${chunk.bare ? 'dropped' : 'chunk'}\0`), log, header.encoded)
  if (!holds(governing.key, signed, chunk.signature, false)) throw new Wrong('forged')
  if (header.sealed > governing.until) throw new Wrong('untrusted', "sealed after the certificate's end")
  const time = await timeOf(event.blockNumber)
  const altered = !chunk.bare && hex(digest(chunk.body)) !== header.bodyDigest
  const restored = !chunk.bare && !altered && header.previous !== head?.digest && withoutBody.delete(header.digest)
  if (!restored) {
    follow(header, at)
    if (chunk.bare) withoutBody.add(header.digest)
    if (header.sealed > time * 1000 + 300000) told('clock', at, 'sealed later than its block')
    if (header.sealed < governing.from) told('clock', at, "sealed before the robot's certificate began")
  }
  if (chunk.bare) return told('dropped', at, '', header.records)
  if (altered) throw new Wrong('altered')
  if (!options.key) return header.records && told('no-grant', at, '', header.records)
  let unsynchronised = 0
  for (const [n, line] of open(chunk, log, options.key).entries()) {
    let found
    try {
      found = kindOf(line)
    } catch (error) {
      told('unopenable', at, `line ${n}: ${error.message}`)
      continue
    }
    if (found.kind === 'lost') told('lost', at, '', Number(found.captured))
    if (found.kind === 'trigger') told('triggered', at)
    if (found.kind !== 'message') continue
    unsynchronised += found.captured === 'false'
    const proof = {
      chunk: at, record: n, stream: hex(header.stream), number: Number(header.number), digest: header.digest,
      sealed: new Date(header.sealed).toISOString(), block: event.blockNumber,
      block_time: new Date(time * 1000).toISOString(), transaction: event.transactionHash,
    }
    // The line itself and not what was parsed of it: JavaScript's numbers would lose digits of the times.
    process.stdout.write(`${printable(found.shown).slice(0, -1)},"proof":${JSON.stringify(proof)}}\n`)
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
        told(error.kind, at, error.message, error.kind === 'no-grant' ? parse(getBytes(encoded)).header.records : 1)
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
  head: head && { ...head, number: Number(head.number) },
  certificates: signers.map(({ index, revoked, fingerprint, key }) => ({ index, revoked, fingerprint, trusted: Boolean(key) })),
  findings,
}
process.stderr.write(JSON.stringify(verdict) + '\n')
provider.destroy()
process.exitCode = sound ? 0 : 9
