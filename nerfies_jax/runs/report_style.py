"""Style sheet of a report: light, dark and printed, desktop and phone."""

STYLE = """\
:root {
  color-scheme: light dark;
  --ink: #1f2328;
  --faded: #59636e;
  --paper: #ffffff;
  --raised: #f4f6f8;
  --line: #d5dae0;
  --accent: #0a5fb4;
}
@media (prefers-color-scheme: dark) {
  :root {
    --ink: #e6edf3;
    --faded: #9aa5b1;
    --paper: #0f1318;
    --raised: #1a2028;
    --line: #333c47;
    --accent: #6cb6ff;
  }
}
* { box-sizing: border-box; }
body {
  margin: 0;
  background: var(--paper);
  color: var(--ink);
  font: 16px/1.5 system-ui, sans-serif;
}
main { max-width: 68rem; margin: 0 auto; padding: 1rem; }
h1 { font-size: 1.6rem; line-height: 1.2; overflow-wrap: anywhere; }
h2 { font-size: 1.15rem; margin: 2rem 0 0.5rem; }
.headlines { display: flex; flex-wrap: wrap; gap: 0.75rem; margin: 1rem 0; }
.headlines div {
  flex: 1 1 8rem;
  padding: 0.6rem 0.9rem;
  background: var(--raised);
  border: 1px solid var(--line);
  border-radius: 0.5rem;
}
dt { color: var(--faded); font-size: 0.9rem; }
dd { margin: 0; font-size: 1.4rem; white-space: nowrap; }
.notes { padding: 0.6rem 0.9rem 0.6rem 2rem; border-left: 4px solid var(--accent); }
.notes, pre { background: var(--raised); }
figure { margin: 1.5rem 0; }
figcaption { color: var(--faded); font-size: 0.9rem; margin-top: 0.3rem; }
.wide { overflow-x: auto; }
.wide:focus-visible { outline: 3px solid var(--accent); }
img, video { display: block; max-width: 100%; height: auto; border-radius: 0.3rem; }
img { background: #ffffff; min-width: min(20rem, 100%); }
a { color: var(--accent); }
.print { display: none; }
video { width: 40rem; max-height: 80vh; background: #000000; }
table { border-collapse: collapse; width: 100%; }
th, td { padding: 0.35rem 0.8rem 0.35rem 0; border-bottom: 1px solid var(--line); }
th { text-align: left; font-weight: normal; }
thead th { color: var(--faded); font-size: 0.9rem; }
th, td { vertical-align: top; }
th small { display: block; color: var(--faded); font-size: 0.85rem; }
.group th { padding-top: 1.2rem; font-weight: bold; }
td code { overflow-wrap: anywhere; }
.number { font-variant-numeric: tabular-nums; }
.number, .better { white-space: nowrap; }
.bar { width: 45%; white-space: nowrap; }
.bar span {
  display: inline-block;
  height: 0.8em;
  margin-right: 0.5em;
  max-width: calc(100% - 3.5em);
  background: var(--accent);
}
code, pre { font: 0.9rem/1.5 ui-monospace, monospace; }
pre { padding: 0.7rem 0.9rem; overflow-x: auto; border-radius: 0.4rem; }
summary { margin: 2rem 0 0.5rem; font-size: 1.15rem; font-weight: bold; }
@media (max-width: 40rem) {
  img.broad { max-width: none; width: 60rem; }
  th, td { padding-right: 0.5rem; }
  pre { white-space: pre-wrap; overflow-wrap: anywhere; }
  .metrics thead { display: none; }
  .metrics tr { display: block; border-bottom: 1px solid var(--line); }
  .metrics th, .metrics td { border: 0; }
  .metrics th { display: block; padding-bottom: 0; }
  .metrics td { display: inline-block; padding-top: 0.1rem; }
  .metrics .number { min-width: 50%; }
}
@page { margin: 15mm; }
@media print {
  :root {
    color-scheme: light;
    --ink: #000000;
    --faded: #444444;
    --paper: #ffffff;
    --raised: #ffffff;
    --line: #bbbbbb;
    --accent: #0a5fb4;
  }
  body { font-size: 10pt; print-color-adjust: exact; }
  main { max-width: none; padding: 0; }
  h1 { font-size: 16pt; }
  h2, summary, .group { break-after: avoid; }
  figure, tr, .headlines div, section, .notes li { break-inside: avoid; }
  thead { display: table-header-group; }
  .wide { overflow: visible; }
  img, img.broad { width: auto; max-width: 100%; max-height: 230mm; }
  video { display: none; }
  img.print { display: block; width: 90mm; }
  span.print { display: inline; }
  pre { border: 1px solid var(--line); white-space: pre-wrap; overflow-wrap: anywhere; }
  a { color: inherit; }
  details table, details code { font-size: 8pt; }
  details th, details td { padding-top: 0.1rem; padding-bottom: 0.1rem; }
  details::details-content { display: block; content-visibility: visible; }
  summary { list-style: none; }
}
"""
