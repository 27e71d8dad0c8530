// A flight as users of node-mavlink write it: arm, take off, watch the height, land.
//
// Knows nothing of zsim. Run: NODE_PATH=… node node_takeoff.cjs PORT SYSTEM; prints what it saw as JSON.

const dgram = require('node:dgram')
const { PassThrough } = require('node:stream')
const { MavLinkPacketSplitter, MavLinkPacketParser, MavLinkProtocolV2 } = require('node-mavlink')
const { minimal, standard, common, ardupilotmega } = require('mavlink-mappings')

const REGISTRY = { ...minimal.REGISTRY, ...(standard ? standard.REGISTRY : {}), ...common.REGISTRY, ...ardupilotmega.REGISTRY }
const PATIENCE_MS = 60000
const SYSTEM = Number(process.argv[3])
const [TAKEOFF, ARM, LAND] = [22, 400, 21] // MAV_CMD

const socket = dgram.createSocket('udp4')
const stream = new PassThrough()
const packets = stream.pipe(new MavLinkPacketSplitter()).pipe(new MavLinkPacketParser())
const protocol = new MavLinkProtocolV2(255, 190)
const seen = { messages: {}, acks: [], texts: [] }
let peer = null
let seq = 0
let phase = 'start'

function send (message) {
  socket.send(protocol.serialize(message, seq++), peer.port, peer.address)
}

function command (id, params = {}) {
  const message = new common.CommandLong()
  Object.assign(message, { command: id, targetSystem: SYSTEM, targetComponent: 1, confirmation: 0, ...params })
  send(message)
}

const steps = {
  Heartbeat (data) {
    if (phase === 'start') {
      phase = 'arming'
      command(ARM, { _param1: 1 })
    } else if (phase === 'landing' && !(data.baseMode & 128)) {
      seen.disarmed = true
      console.log(JSON.stringify(seen))
      process.exit(0)
    }
  },
  CommandAck (data) {
    seen.acks.push([Number(data.command), Number(data.result)])
    if (phase === 'arming' && Number(data.command) === ARM && Number(data.result) === 0) {
      phase = 'climbing'
      command(TAKEOFF, { _param7: NaN })
    }
  },
  LocalPositionNed (data) {
    if (phase === 'climbing' && data.z < -2.2) {
      seen.height_m = -data.z
      phase = 'landing'
      command(LAND)
    }
  },
  StatusText (data) {
    seen.texts.push(data.text)
  }
}

packets.on('data', packet => {
  const kind = REGISTRY[packet.header.msgid]
  if (!kind) throw new Error(`no class for message ${packet.header.msgid}`)
  const data = packet.protocol.data(packet.payload, kind)
  seen.messages[kind.MSG_NAME] = (seen.messages[kind.MSG_NAME] || 0) + 1
  const step = steps[kind.name]
  if (step) step(data)
})
socket.on('message', (data, from) => {
  peer = from
  stream.write(data)
})
socket.bind(Number(process.argv[2]), '127.0.0.1')
setTimeout(() => {
  console.error(`still ${phase}: ${JSON.stringify(seen)}`)
  process.exit(1)
}, PATIENCE_MS)
