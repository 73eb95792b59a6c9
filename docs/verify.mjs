// Reads a robot's log from a chain and proves it, independently of rosbridge_eth: written from docs/log.md alone,
// on ethers (the chain), sm-crypto-v2 (SM2, SM3, SM4) and fzstd (Zstandard).
//
//   npm ci && node verify.mjs --node URL --contract ADDRESS --robot NAME --ca ca.crt.pem [--key HEX] [--archive FOLDER]
//
// --key is the reader's private encryption key, 32 bytes in hex; without it everything but the content is checked. It is
//   sm2.PrivateKey.from_pem(open("enc.key.pem", "rb").read(), password=b"…").to_bytes().hex() in smcrypto.
// --archive is a folder with the bodies of archived chunks, or a copy of it; without it they are not looked at.
// Proven records go to stdout as JSON lines, the verdict as one JSON object to stderr. Exit code 0: sound; 9: not.

import { existsSync, readFileSync } from 'node:fs'
import { parseArgs } from 'node:util'
import { Contract, JsonRpcProvider, id as keccakOfText, getBytes, keccak256 } from 'ethers'
import { decompress } from 'fzstd'
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
const MAX = { body: 65536, archived: 1 << 24, readers: 16, records: 1000, plaintext: 4 << 20 }
const FIXED = 1 + 1 + 16 + 8 + 32 + 8 + 4 + 32 + 4 + 32 + 1
const GRANT = 8 + 113
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

function element(der, at) {
  let length = der[at + 1]
  let start = at + 2
  if (length >= 0x80) {
    start += length & 0x7f
    length = Number(number(der.slice(at + 2, start)))
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

function certificate(der) {
  const [signed, , signature] = members(element(der, 0).content)
  const parts = members(signed.content).filter((part) => part.tag !== 0xa0) // without the version
  const [, , issuer, validity, subject, keyInfo, ...rest] = parts
  const [from, until] = members(validity.content).map(({ tag, content }) => {
    const t = Buffer.from(content).toString('latin1')
    const full = tag === 0x17 ? (t < '50' ? '20' : '19') + t : t
    return Date.parse(full.replace(/^(....)(..)(..)(..)(..)(..)Z$/, '$1-$2-$3T$4:$5:$6Z'))
  })
  const names = []
  for (const { tag, content } of rest.filter((part) => part.tag === 0xa3)) {
    for (const extension of members(members(content)[0].content)) {
      const [oid, ...values] = members(extension.content)
      if (hex(oid.content) !== '551d11') continue // subjectAltName
      for (const name of members(members(values.at(-1).content)[0].content)) {
        names.push(`${name.tag & 0x1f}:${Buffer.from(name.content).toString('latin1')}`)
      }
    }
  }
  return {
    signed: signed.whole, signature: signature.content.slice(1), issuer: hex(issuer.whole), subject: hex(subject.whole),
    key: hex(members(keyInfo.content)[1].content.slice(1)), from, until, names, size: element(der, 0).end,
  }
}

// The signing certificate of a registration, if the CA signed it for this robot and it had not ended then. That it
// begins later than its block is a chain whose clock is behind.
function signer(certificates, roots, robot, blockTime) {
  const made = certificate(certificates)
  const root = roots.find((one) => one.subject === made.issuer && holds(one.key, made.signed, made.signature, true))
  if (!root) throw new Wrong('untrusted', 'not signed by the CA')
  if (made.names.join() !== `6:urn:rosbridge-eth:robot:${robot}`) throw new Wrong('untrusted', `for ${made.names}`)
  const at = Math.max(blockTime * 1000, made.from, root.from)
  if (at > made.until || at > root.until) throw new Wrong('untrusted', 'had ended when it was registered')
  return made
}

// --- chunks

function parse(data) {
  if (data.length < FIXED + 64) throw new Wrong('malformed', `${data.length} bytes`)
  let at = 0
  const take = (size) => data.slice(at, (at += size))
  const [version, flags] = take(2)
  const header = {
    goodbye: Boolean(flags & 1), archived: Boolean(flags & 2), stream: take(16), number: number(take(8)), previous: hex(take(32)),
    sealed: Number(number(take(8))), records: Number(number(take(4))), root: hex(take(32)),
    bodyLength: Number(number(take(4))), bodyDigest: hex(take(32)), grants: [],
  }
  const [count] = take(1)
  for (let n = 0; n < count; n++) header.grants.push([hex(take(8)), take(113)])
  header.encoded = data.slice(0, at)
  header.digest = hex(digest(header.encoded))
  const signature = take(64)
  const body = data.slice(at)
  const empty = header.records === 0
  const formed = version === 2 && flags <= 3 && signature.length === 64 && header.sealed < 253402300800000 &&
    (body.length === 0 || body.length === header.bodyLength) && (empty
    ? !header.archived && header.bodyLength === 0 && count === 0 && header.root === hex(digest()) && header.bodyDigest === hex(digest())
    : header.records <= MAX.records && count >= 1 && count <= MAX.readers && header.bodyLength > 16 &&
      header.bodyLength <= (header.archived ? MAX.archived : MAX.body) && (header.bodyLength - 16) % 64 === 0)
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

function open({ header, body }, log, readerKey) {
  if (header.records === 0) return []
  const place = join(header.stream, bigEndian(header.number, 8))
  const publicKey = getBytes('0x' + sm2.getPublicKeyFromPrivateKey(readerKey))
  const tag = hex(digest(place, publicKey).slice(0, 8))
  const grants = header.grants.filter(([name]) => name === tag)
  if (!grants.length) throw new Wrong('no-grant')
  // C1 | C3 | C2, GB/T 32918.4; the library wants C1 without its leading 04.
  const keys = grants.map(([, wrapped]) => sm2.doDecrypt(hex(wrapped.slice(1)), readerKey, 1, { output: 'array' }))
  const key = keys.find((one) => one.length === 16)
  if (!key) throw new Wrong('unopenable', 'the wrapped key')
  let lines
  try {
    const plaintext = sm4.decrypt(body.slice(0, -16), key, {
      mode: 'gcm', iv: new Uint8Array(12), associatedData: join(log, place), tag: body.slice(-16), output: 'array',
    })
    const end = frameEnd(plaintext)
    const padding = plaintext.slice(end)
    if (padding.length >= 64 || padding.some((byte) => byte)) throw new Error('no padding')
    const content = Buffer.from(decompress(plaintext.slice(0, end)))
    if (content.length > (header.archived ? MAX.archived : MAX.plaintext) || content.at(-1) !== 10) throw new Error('no lines')
    lines = []
    for (let at = 0, end; at < content.length; at = end + 1) lines.push(content.subarray(at, (end = content.indexOf(10, at))))
  } catch (error) {
    throw new Wrong('unopenable', error.message)
  }
  const salt = (n) => hmac(key, bigEndian(n, 4)).slice(0, 16)
  const found = root(lines.map((line, n) => digest([0], salt(n), line)))
  if (lines.length !== header.records || found !== header.root) throw new Wrong('unopenable', 'another root')
  return lines
}

// Where the Zstandard frame ends (RFC 8878, 3.1.1): a frame does not say so, its blocks do. Zeros follow it.
function frameEnd(data) {
  if (hex(data.slice(0, 4)) !== '28b52ffd') throw new Error('no frame')
  const descriptor = data[4]
  const single = (descriptor >> 5) & 1
  let at = 5 + (single ? 0 : 1) + [0, 1, 2, 4][descriptor & 3] + [single, 2, 4, 8][descriptor >> 6]
  for (let last = 0; !last;) {
    if (at + 3 > data.length) throw new Error('the frame has no end')
    const block = data[at] | (data[at + 1] << 8) | (data[at + 2] << 16)
    last = block & 1
    at += 3 + (((block >> 1) & 3) === 1 ? 1 : block >> 3)
  }
  return at + ((descriptor >> 2) & 1 ? 4 : 0)
}

// --- the reading

const { values: options } = parseArgs({
  options: Object.fromEntries(['node', 'contract', 'robot', 'ca', 'key', 'archive'].map((name) => [name, { type: 'string' }])),
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
const NOTICES = new Set(['dropped', 'lost', 'triggered', 'restarted', 'no-grant', 'archived', 'clock'])
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
const newest = registrations.findLast((event) => event.eventName === 'Registered')
if (newest && keccak256(newest.args.certificates) !== standing.certificatesHash) told('withheld', end, 'a registration')
const signers = []
for (const event of registrations) {
  const one = { index: Number(event.args.index), block: event.blockNumber, revoked: event.eventName === 'Revoked' }
  if (!one.revoked) {
    const certificates = getBytes(event.args.certificates)
    one.fingerprint = hex(digest(certificates.slice(0, element(certificates, 0).end)))
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
  const purposes = !chunk.bare ? ['chunk'] : header.archived ? ['chunk', 'dropped'] : ['dropped']
  const purpose = purposes.find((one) =>
    holds(governing.key, join(text.encode(`rosbridge-eth/2 ${one}\0`), log, header.encoded), chunk.signature, false))
  if (!purpose) throw new Wrong('forged')
  if (header.sealed > governing.until) throw new Wrong('untrusted', "sealed after the certificate's end")
  follow(header, at)
  if (header.sealed > (await timeOf(event.blockNumber)) * 1000 + 300000) told('clock', at, 'sealed later than its block')
  if (purpose === 'dropped') return told('dropped', at, '', header.records)
  if (chunk.bare) {
    if (!options.archive) return told('archived', at, '', header.records)
    const file = `${options.archive}/${header.bodyDigest.slice(0, 2)}/${header.bodyDigest}`
    if (existsSync(file)) chunk.body = new Uint8Array(readFileSync(file))
    if (chunk.body.length !== header.bodyLength || hex(digest(chunk.body)) !== header.bodyDigest) throw new Wrong('withheld')
  } else if (hex(digest(chunk.body)) !== header.bodyDigest) throw new Wrong('altered')
  if (!options.key) return header.records && told('no-grant', at, '', header.records)
  for (const [n, line] of open(chunk, log, options.key).entries()) {
    const shown = line.toString('utf8')
    let value = null
    try {
      value = JSON.parse(shown)
    } catch {}
    if (typeof value !== 'object' || value === null) {
      told('unopenable', at, `line ${n} is no JSON object`)
      continue
    }
    if (value.lost !== undefined) told('lost', at, '', value.lost)
    if (value.trigger !== undefined) told('triggered', at)
    if (value.topic === undefined || value.data === undefined) continue
    const proof = { chunk: at, record: n, digest: header.digest, block: event.blockNumber, transaction: event.transactionHash }
    // The line itself and not what was parsed of it: JavaScript's numbers would lose digits of the times.
    process.stdout.write(`${printable(shown).slice(0, -1)},"proof":${JSON.stringify(proof)}}\n`)
    records += 1
  }
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
