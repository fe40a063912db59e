// Which rendition this device decodes, asked of the browser before the offer is made: a headset that stutters shows nobody anything.

const FRAME_RATE = 30;
const PATIENCE_MS = 3000;

/**
 * The WHEP address that asks for at most the best rendition that is decoded smoothly, or, where none is, for the smallest; the same
 * address when it asks for a rendition already or the browser does not tell.
 *
 * @param {string} url POST /whep/{stream}
 * @param {() => Promise<{protocol: string, renditions?: {name: string, width?: number, height?: number, bitrate_bps?: number}[]}[]>} playback
 */
export async function withinReach(url, playback, smooth = decodesSmoothly) {
  const address = new URL(url);
  if (['rendition', 'at_most'].some((name) => address.searchParams.has(name))) return url;
  const name = await Promise.race([
    bestOf(playback, smooth).catch(() => null),
    new Promise((resolve) => setTimeout(resolve, PATIENCE_MS, null)),
  ]);
  if (name !== null) address.searchParams.set('at_most', name);
  return address.href;
}

/** The name of the best rendition that is decoded smoothly; null for the first, which needs no asking. */
async function bestOf(playback, smooth) {
  const renditions = (await playback()).find(({ protocol }) => protocol === 'whep')?.renditions ?? [];
  for (const [index, rendition] of renditions.entries()) {
    if (!rendition.width) return null;      // no picture yet: nobody knows
    if (await smooth(rendition)) return index === 0 ? null : rendition.name;
  }
  return renditions.at(-1)?.name ?? null;
}

async function decodesSmoothly({ width, height, bitrate_bps: bitrate }) {
  if (!navigator.mediaCapabilities?.decodingInfo) return true;
  const contentType = 'video/H264;level-asymmetry-allowed=1;packetization-mode=1;profile-level-id=42e01f';
  const info = await navigator.mediaCapabilities.decodingInfo(
    { type: 'webrtc', video: { contentType, width, height, bitrate, framerate: FRAME_RATE } });
  return info.smooth || !info.supported;    // unsupported: VP8 then, of which it says less
}
