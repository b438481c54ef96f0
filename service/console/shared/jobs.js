// Long work: a job is followed to its end, with its progress and a way to cancel it.
import { follow, get, may, pathOf, post } from "./api.js";
import { Moment, Pill, Progress, Trouble } from "./elements.js";
import { integer } from "./formats.js";
import { html, useEffect, useRef, useState } from "./view.js";

const TONES = { queued: "", running: "on", succeeded: "good", failed: "bad", cancelled: "warn" };

export function hasEnded(job) {
  return ["succeeded", "failed", "cancelled"].includes(job.state);
}

export function JobState({ job }) {
  return html`<${Pill} tone=${TONES[job.state]}>${job.cancelling && !hasEnded(job) ? "cancelling" : job.state}<//>`;
}

/** A job as it stands, followed to its end; onEnd gets it then. */
export function useJob(job, onEnd) {
  const [present, setPresent] = useState(job);
  const [error, setError] = useState(null);
  const ended = useRef(onEnd);
  ended.current = onEnd;
  useEffect(() => {
    setPresent(job);
    if (!job || hasEnded(job)) return undefined;
    const controller = new AbortController();
    let last = job;
    const onEvent = (_name, told) => {
      last = told;
      setPresent(told);
      if (hasEnded(told)) {
        controller.abort();
        ended.current?.(told);
      }
    };
    follow(pathOf("jobs", job.id, "events"), { onEvent, signal: controller.signal })
      .then(async () => {
        if (!controller.signal.aborted && !hasEnded(last)) onEvent("", await get(pathOf("jobs", job.id)));
      })
      .catch(setError);
    return () => controller.abort();
  }, [job?.id]);
  return { job: present, error };
}

/** The progress of a job, in a line. */
export function JobProgress({ job, onEnd, what }) {
  const { job: present, error } = useJob(job, onEnd);
  if (error) return html`<${Trouble} error=${error} />`;
  const { done, total, message } = present.progress;
  if (present.state === "failed" && present.problem) {
    return html`<${Trouble} error=${{ title: present.problem.title, detail: present.problem.detail }} />`;
  }
  return html`
    <div class="stack job" aria-live="polite">
      <div class="spread">
        <span>${what || present.kind} <${JobState} job=${present} /></span>
        <span class="row">
          ${total ? html`<span class="small">${integer(done)} of ${integer(total)}</span>` : null}
          ${!hasEnded(present) && !present.cancelling && may("enrol") && html`<${CancelJob} job=${present} />`}
        </span>
      </div>
      ${!hasEnded(present) && html`<${Progress} done=${done} total=${total} label=${`Progress of ${what || present.kind}`} />`}
      ${!hasEnded(present) && message && html`<p class="faint small">${message}</p>`}
      ${hasEnded(present) && html`<p class="faint small">ended <${Moment} at=${present.ended_at} /></p>`}
    </div>
  `;
}

export function CancelJob({ job, done }) {
  const [error, setError] = useState(null);
  const cancel = () => post(pathOf("jobs", job.id, "cancel")).then((told) => done?.(told), setError);
  return html`
    <button type="button" class="small" onClick=${cancel}>Cancel</button>
    ${error && html`<span class="faint small" role="alert">${error.detail || error.message}</span>`}
  `;
}
