// A CiA 402 drive on the CANopen stack of the npm package `canopen`: node device.js INTERFACE NODE_ID
// Object dictionary, SDO, NMT, heartbeat and PDO on SYNC are that stack's; this file adds the objects of a drive and what
// they do. The shaft turns by itself: each SYNC adds STEP counts, so that a listener recognises a lost sample.
'use strict';

const { Device, DataType, ObjectType, AccessType } = require('canopen');
const can = require('socketcan');

const STEP = 7;
const STATES = { off: 0x0250, ready: 0x0231, on: 0x0233, enabled: 0x0237, quickStop: 0x0217 };

const [interfaceName, nodeText] = process.argv.slice(2);
const nodeId = Number(nodeText);
const device = new Device({ id: nodeId });
const { eds } = device;

function variable(index, parameterName, dataType, value = 0, accessType = AccessType.READ_WRITE) {
    const entry = eds.addEntry(index, { parameterName, dataType, accessType, objectType: ObjectType.VAR });
    entry.value = value;
    return entry;
}

function record(index, parameterName, fields) {
    const entry = eds.addEntry(index, { parameterName, objectType: ObjectType.RECORD });
    fields.forEach(([subindex, dataType, value]) => {
        entry.addSubObject(subindex, { parameterName: `${parameterName} ${subindex}`, dataType, accessType: AccessType.READ_WRITE });
        entry[subindex].value = value;
    });
    return entry;
}

eds.setIdentity({ vendorId: 0x5A, productCode: 0x40200, revisionNumber: 1, serialNumber: 77 });
eds.addSdoServerParameter(0, 0x580 + nodeId, 0x600 + nodeId);
variable(0x1017, 'Producer heartbeat time', DataType.UNSIGNED16); // the stack's own helper makes it 32 bits wide
variable(0x1005, 'COB-ID SYNC', DataType.UNSIGNED32, 0x80);
variable(0x1008, 'Manufacturer device name', DataType.VISIBLE_STRING, 'foreign drive');
const controlword = variable(0x6040, 'Controlword', DataType.UNSIGNED16);
const statusword = variable(0x6041, 'Statusword', DataType.UNSIGNED16, STATES.off);
const mode = variable(0x6060, 'Modes of operation', DataType.INTEGER8, 8);
const modeDisplay = variable(0x6061, 'Modes of operation display', DataType.INTEGER8, 8);
const position = variable(0x6064, 'Position actual value', DataType.INTEGER32, 1000 * nodeId);
const current = variable(0x6074, 'Torque demand', DataType.INTEGER16, -nodeId);
variable(0x6075, 'Motor rated current', DataType.UNSIGNED32, 2000);
variable(0x6076, 'Motor rated torque', DataType.UNSIGNED32, 0);
variable(0x607A, 'Target position', DataType.INTEGER32);
variable(0x6081, 'Profile velocity', DataType.UNSIGNED32);
variable(0x6083, 'Profile acceleration', DataType.UNSIGNED32);
variable(0x6084, 'Profile deceleration', DataType.UNSIGNED32);

// Four PDOs a direction with the predefined COB-IDs; all are invalid (bit 31) and empty until a master maps them.
for (let number = 0; number < 4; ++number) {
    for (const [communication, cobId] of [[0x1400, 0x200], [0x1800, 0x180]]) {
        record(communication + number, 'PDO communication', [
            [1, DataType.UNSIGNED32, (0x80000000 | (cobId + 0x100 * number + nodeId)) >>> 0],
            [2, DataType.UNSIGNED8, 255],
        ]);
        const mapping = record(communication + 0x200 + number, 'PDO mapping',
            [1, 2, 3, 4].map((subindex) => [subindex, DataType.UNSIGNED32, 0]));
        mapping[0].value = 0;
    }
}

mode.addListener('update', () => { modeDisplay.value = mode.value; });
controlword.addListener('update', () => {
    const command = controlword.value & 0x8F;
    if ((command & 0x82) === 0) statusword.value = STATES.off;
    else if ((command & 0x86) === 0x02) statusword.value = statusword.value === STATES.enabled ? STATES.quickStop : STATES.off;
    else if ((command & 0x87) === 0x06) statusword.value = STATES.ready;
    else if ((command & 0x8F) === 0x07 && statusword.value !== STATES.off) statusword.value = STATES.on;
    else if ((command & 0x8F) === 0x0F && statusword.value === STATES.on) statusword.value = STATES.enabled;
});

const channel = can.createRawChannel(interfaceName, false);
device.addListener('message', (message) => channel.send(message));
channel.addListener('onMessage', (message) => {
    device.receive(message);
    if (message.id === 0x80) position.value += STEP; // what the next SYNC will report
});
channel.start();
device.start();
console.log('ready');

process.on('SIGTERM', () => {
    device.stop();
    channel.stop();
    process.exit(0);
});
