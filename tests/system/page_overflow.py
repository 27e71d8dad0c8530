"""Detection, in the browser, of parts of a page that are cut off, out of reach or overwritten."""

from typing import Any

FAULTS_JS = """() => {
  const SLACK_PX = 1.5, OVER_PX = 3;  // of rounding; of two texts that touch
  const faults = [];
  const name = (node) => {
    const element = node.nodeType === 3 ? node.parentElement : node;
    return `${element.tagName.toLowerCase()}.${element.className} '${node.textContent.trim().slice(0, 40)}'`;
  };
  if (document.documentElement.scrollWidth > innerWidth || document.body.scrollWidth > innerWidth)
    faults.push(`the page is ${document.documentElement.scrollWidth} px wide`);

  // The part of a text's box that its ancestors show, and why a part is not shown.
  function visible(node, box) {
    let { left, right, top, bottom } = box, cut = "", scrolls = false;
    for (let each = node.parentElement; each && each !== document.body; each = each.parentElement) {
      const style = getComputedStyle(each), frame = each.getBoundingClientRect();
      const ellipsis = style.textOverflow === "ellipsis", folded = style.webkitLineClamp !== "none";
      for (const [overflow, low, high, from, to, axis] of [
        [style.overflowX, left, right, frame.left, frame.right, "sideways"],
        [style.overflowY, top, bottom, frame.top, frame.bottom, "in height"]]) {
        if (overflow === "visible" || (low >= from - SLACK_PX && high <= to + SLACK_PX)) continue;
        if (axis === "in height" && (overflow === "auto" || overflow === "scroll")) scrolls = true;
        else if (!scrolls && !(axis === "sideways" ? ellipsis : folded)) cut = `cut ${axis} by ${name(each).slice(0, 60)}`;
      }
      if (style.overflowX !== "visible") { left = Math.max(left, frame.left); right = Math.min(right, frame.right); }
      if (style.overflowY !== "visible") { top = Math.max(top, frame.top); bottom = Math.min(bottom, frame.bottom); }
      if (style.position === "fixed" && !each.closest("#root")) break;
    }
    if (!scrolls && (left < -SLACK_PX || right > innerWidth + SLACK_PX)) cut = "outside of the page sideways";
    if (!scrolls && (top < -SLACK_PX || bottom > innerHeight + SLACK_PX)) cut = "outside of the page in height";
    return { left, right, top, bottom, cut };
  }

  const texts = [];
  const walker = document.createTreeWalker(document.body, NodeFilter.SHOW_TEXT);
  for (let node = walker.nextNode(); node; node = walker.nextNode()) {
    const parent = node.parentElement;
    if (!node.textContent.trim() || parent.closest("script, style, noscript, option, [aria-hidden=true]")) continue;
    if (!parent.checkVisibility({ opacityProperty: true, visibilityProperty: true })) continue;
    const range = document.createRange();
    range.selectNodeContents(node);
    for (const box of range.getClientRects()) {
      if (box.width < 1 || box.height < 1) continue;
      const seen = visible(node, box);
      if (seen.cut) faults.push(`${name(node)} is ${seen.cut}`);
      if (seen.right - seen.left > 1 && seen.bottom - seen.top > 1) texts.push({ node, ...seen });
    }
  }
  const shownOnTop = ({ node, left, right, top, bottom }) => {
    const found = document.elementFromPoint((left + right) / 2, (top + bottom) / 2);
    return found && (node.parentElement.contains(found) || found.contains(node.parentElement));
  };
  const shown = texts.filter(shownOnTop);
  for (let i = 0; i < shown.length; i++) for (let k = i + 1; k < shown.length; k++) {
    const [a, b] = [shown[i], shown[k]];
    if (a.node === b.node) continue;
    const width = Math.min(a.right, b.right) - Math.max(a.left, b.left);
    const height = Math.min(a.bottom, b.bottom) - Math.max(a.top, b.top);
    if (width > OVER_PX && height > OVER_PX) faults.push(`${name(a.node)} is written over ${name(b.node)}`);
  }
  for (const bar of document.querySelectorAll(".mantine-ScrollArea-scrollbar[data-orientation=vertical]")) {
    const { left, right, top, bottom } = bar.getBoundingClientRect();
    const under = ({ node, ...box }) => bar.parentElement.contains(node)
      && Math.min(box.right, right) - Math.max(box.left, left) > OVER_PX && box.bottom > top && box.top < bottom;
    if (bar.checkVisibility()) faults.push(...texts.filter(under).map(({ node }) => `${name(node)} is under a scroll bar`));
  }
  for (const panel of document.querySelectorAll("#zsim-head, #zsim-tools, #zsim-record, .mantine-ScrollArea-viewport"))
    if (panel.checkVisibility() && panel.scrollWidth > panel.clientWidth + 1)
      faults.push(`${name(panel).slice(0, 60)} is ${panel.scrollWidth} px wide in ${panel.clientWidth} px`);
  return [...new Set(faults)];
}"""


def overflow(page: Any) -> list[str]:
    """Return descriptions of what is cut off, out of reach or overwritten on a page."""
    return page.evaluate(FAULTS_JS)
