// ICE restart over WHEP (RFC 9725 section 4.3.3): what goes into the PATCH, and what its answer makes of the session. No DOM here.

const OF_A_CANDIDATE = /^a=(candidate:|end-of-candidates)/;

/** The application/trickle-ice-sdpfrag body of a local description: credentials and candidates of the transport all media shares. */
export function restartFragment(sdp) {
  const [, first] = sections(sdp);
  const kind = first[0].match(/^m=(\w+)/)[1];
  const head = first.filter((line) => /^a=(mid:|ice-ufrag:|ice-pwd:)/.test(line));
  return joined([`m=${kind} 9 UDP/TLS/RTP/SAVPF 0`, ...head, ...first.filter((line) => OF_A_CANDIDATE.test(line))]);
}

/** The remote description with the credentials and candidates of the server's fragment; null if it has none. */
export function restartedAnswer(sdp, fragment) {
  const lines = fragment.split(/\r?\n/);
  const username = lines.find((line) => line.startsWith('a=ice-ufrag:'));
  const password = lines.find((line) => line.startsWith('a=ice-pwd:'));
  if (!username || !password) return null;
  const [session, ...media] = sections(sdp).map((section) => section.filter((line) => !OF_A_CANDIDATE.test(line))
    .map((line) => (line.startsWith('a=ice-ufrag:') ? username : line.startsWith('a=ice-pwd:') ? password : line)));
  media[0].push(...lines.filter((line) => OF_A_CANDIDATE.test(line)));
  return joined([...session, ...media.flat()]);
}

/** The lines before the first media section, then those of each one. */
function sections(sdp) {
  const parts = [[]];
  for (const line of sdp.split(/\r?\n/).filter(Boolean)) {
    if (line.startsWith('m=')) parts.push([]);
    parts.at(-1).push(line);
  }
  return parts;
}

const joined = (lines) => lines.map((line) => `${line}\r\n`).join('');
