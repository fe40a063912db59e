// The renderer's times from /stats, as rows of a table.

/** @returns {Array<[string, string, string]>} name, median and 95th percentile in ms; the whole frame first */
export function stageRows(stats) {
  const { render_ms: whole, stages_ms: stages = {} } = stats;
  if (!whole) return [];
  const milliseconds = (value) => (Number.isFinite(value) ? value.toFixed(1) : '–');
  return [['whole frame', whole], ...Object.entries(stages)]
    .map(([name, { p50, p95 }]) => [name.replaceAll('_', ' '), milliseconds(p50), milliseconds(p95)]);
}

/** What is behind the times, in one line. */
export function statsLine({ fps, frames_dropped: dropped, viewers }) {
  if (fps === undefined) return 'The renderer has not started yet.';
  return `${fps.toFixed(1)} frames a second, ${dropped} dropped, ${viewers === 1 ? '1 viewer' : `${viewers} viewers`}.`;
}
