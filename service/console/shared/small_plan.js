// A plan beside something else: the places of a map, and marks that move.
import { isDark, onTheme } from "./colours.js";
import { PlanCanvas } from "./plan_canvas.js";
import { contentOf, presentTints } from "./plan_content.js";
import { html, useEffect, useMemo, useRef, useState } from "./view.js";

const NONE = {};

/** plan: of readPlan; marks: as PlanCanvas has them; look: all is seen anew when it changes. */
export function SmallPlan({ plan, label, marks = NONE, look = 0 }) {
  const [places, above] = [useRef(null), useRef(null)];
  const drawing = useRef(null);
  const [theme, setTheme] = useState(isDark());
  useEffect(() => onTheme(() => setTheme(isDark())), []);
  useEffect(() => {
    drawing.current = new PlanCanvas(places.current, above.current, {});
    return () => drawing.current.close();
  }, []);
  useEffect(() => drawing.current.mark({ chosen: null, robots: [], dots: [], misleading: [], ways: [], ...marks }), [marks]); // before it is fitted
  const strips = plan.posed === 0;
  const content = useMemo(() => contentOf(plan, { strips, showGaps: false }), [plan, theme]);
  const fitted = useRef(null);
  useEffect(() => {
    drawing.current.mark({ tints: presentTints() });
    drawing.current.show(content, fitted.current !== look);
    fitted.current = look;
  }, [content, look]);
  return html`
    <div class="plan-canvas small-plan">
      <canvas ref=${places} aria-hidden="true"></canvas>
      <canvas ref=${above} tabindex="0" role="img" aria-label=${`${label} Arrow keys move, plus and minus zoom, 0 shows all.`}></canvas>
    </div>
  `;
}
