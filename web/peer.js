// What a peer connection does for the viewer: receive, gather, tell whether anything comes in.

/** A recvonly connection for picture and sound. */
export function receivingPeer(iceServers) {
  const peer = new RTCPeerConnection({ iceServers, bundlePolicy: 'max-bundle' });
  const video = peer.addTransceiver('video', { direction: 'recvonly' });
  preferH264(video);
  shortenJitterBuffer(video.receiver);
  peer.addTransceiver('audio', { direction: 'recvonly' });
  return peer;
}

function preferH264(transceiver) {
  const codecs = RTCRtpReceiver.getCapabilities?.('video')?.codecs;
  if (!codecs || !transceiver.setCodecPreferences) return;   // an old browser: the server chooses
  const isH264 = (codec) => codec.mimeType.toLowerCase() === 'video/h264';
  transceiver.setCodecPreferences([...codecs.filter(isH264), ...codecs.filter((codec) => !isH264(codec))]);
}

/** Live and interactive: show a frame as soon as it is whole, rather than smoothly and late. */
function shortenJitterBuffer(receiver) {
  if ('jitterBufferTarget' in receiver) receiver.jitterBufferTarget = 0;
  else if ('playoutDelayHint' in receiver) receiver.playoutDelayHint = 0;
}

/** Makes `description` the local one; resolves with all candidates in it, or those that are known after limitMs. */
export async function describeLocally(peer, description, limitMs) {
  const complete = new Promise((resolve) => {
    peer.addEventListener('icecandidate', ({ candidate }) => candidate === null && resolve());
    setTimeout(resolve, limitMs);
  });
  await peer.setLocalDescription(description);
  await complete;
  return peer.localDescription.sdp;
}

/** Of media and whatever else the server sends over the same path. */
export async function bytesReceived(peer) {
  let bytes = 0;
  for (const report of (await peer.getStats()).values()) {
    if (['inbound-rtp', 'transport'].includes(report.type)) bytes += report.bytesReceived ?? 0;
  }
  return bytes;
}

/** Resolves when something comes in. Rejects when the signal ends. */
export async function somethingReceived(peer, signal) {
  const before = await bytesReceived(peer);
  while (await bytesReceived(peer) === before) {
    signal.throwIfAborted();
    await new Promise((resolve) => setTimeout(resolve, 100));
  }
}
